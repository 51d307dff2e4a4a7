"""Comparison of names of classes and labels: of a source, a teacher, knowledge, a query."""

from __future__ import annotations

from collections.abc import Iterable


def folded(name: str) -> str:
    """The words of a name in lower case, one blank between; underscores and hyphens are blanks."""
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


def joined(name: str) -> str:
    """A name as it is compared: tv-screen, TV_Screen and TVScreen are one."""
    return folded(name).replace(" ", "")


def rows_of(names: Iterable[str], vocabulary: Iterable[str]) -> list[int]:
    """Index of each name in the vocabulary, the first of equal ones; -1 where it is not in it."""
    row: dict[str, int] = {}
    for place, name in enumerate(vocabulary):
        row.setdefault(joined(name), place)
    return [row.get(joined(name), -1) for name in names]


def lacking(names: Iterable[str], vocabulary: Iterable[str]) -> list[str]:
    """Those of the names that are not in the vocabulary."""
    listed = list(names)
    return [name for name, row in zip(listed, rows_of(listed, vocabulary), strict=True) if row < 0]
