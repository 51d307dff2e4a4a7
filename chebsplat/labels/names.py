"""Names of classes and labels as they are compared: of a source, of a teacher, of knowledge, and of
who asks.
"""

from __future__ import annotations

from collections.abc import Iterable


def folded(name: str) -> str:
    """The words of a name: lower case, one blank between them; underscores and hyphens are
    blanks.
    """
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


def joined(name: str) -> str:
    """A name as it is compared: tv-screen, TV_Screen and TVScreen are one."""
    return folded(name).replace(" ", "")


def rows_of(names: Iterable[str], known: Iterable[str]) -> list[int]:
    """Index of each name among those known, the first of equal ones; -1 of a name that is not
    known.
    """
    row: dict[str, int] = {}
    for place, name in enumerate(known):
        row.setdefault(joined(name), place)
    return [row.get(joined(name), -1) for name in names]


def lacking(names: Iterable[str], known: Iterable[str]) -> list[str]:
    """Those of the names that are not known."""
    listed = list(names)
    return [name for name, row in zip(listed, rows_of(listed, known), strict=True) if row < 0]
