"""HTML pages: templates, and the functions that fill them. A page is one file that fetches nothing.

`report.html` is the report. Pages include by name what they share: `style.css` wants `narrow`;
`viewer.html` and `viewer.js`, a slider between two pictures, want `modes`, `legend` and, on the
page, `sheet.html` with its `pictures`; `bars.html` wants `classes`. On a screen narrower than
`narrow` pixels the rows of a table become cards, whose cells say
by `data-label` what they are: nothing is cut off, and nothing scrolls sideways.
"""
