"""HTML pages: templates, and the functions that fill them. A page is one file that fetches nothing.

`report.html` is the report. Pages include shared parts by name: `style.css` needs `narrow`;
`viewer.html` and `viewer.js`, a slider between two pictures, need `modes`, `legend` and, on the
page, `sheet.html` with its `pictures`; `bars.html` needs `classes`. On a screen narrower than
`narrow` pixels the rows of a table become cards, with `data-label` as headings of the cells:
nothing is cut off, and nothing scrolls sideways.
"""
