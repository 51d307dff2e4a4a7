"""From a template to a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

SHARED = Path(__file__).parent
REPORT = SHARED / "report.html"


def rendered(template: Path, narrow: int = 700, **values: Any) -> str:
    """A page of its template. Raises jinja2's UndefinedError for a value that it wants and is not given."""
    import jinja2

    loader = jinja2.FileSystemLoader([template.parent, SHARED])
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.get_template(template.name).render(narrow=narrow, **values)
