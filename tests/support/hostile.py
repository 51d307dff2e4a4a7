"""Names that HTML, Markdown, a template or matplotlib would take for their own, and what a page
makes of them.
"""

import re
from html.parser import HTMLParser

NAMES = [
    "<svg><script>alert(1)</script>", "<img src=x onerror=alert(1)>",
    "\"><b onmouseover='alert(1)'>",
    "</script><script>alert(1)</script>", "</style></textarea>--><script>alert(1)</script>",
    "a_b_c *x*", "`rm -rf`",
    "{{ 7 * 7 }}{% if %}", "$x$ and $\\frac", "[a](javascript:alert(1))", "| a | b |", "# a",
    "&lt;b&gt; &amp;",
    "_x", "x" * 200,
]  # fmt: skip


class Shape(HTMLParser):
    """tags: those of a page in order, with their attributes' names; text: what it shows, a space
    between words.
    """

    def __init__(self, page):
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(page)
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, *(name for name, _ in attributes)))

    def handle_data(self, data):
        self.text += data


def shown_in(markdown):
    """Text of Markdown whose names are all escaped, as a reader sees it."""
    text = re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", markdown)
    return text.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
