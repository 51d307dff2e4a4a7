"""Names of views and labels: text that can be printed, searched for, and written as UTF-8."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable
from typing import Any

from chebsplat.errors import InputError

LONGEST = 200  # characters of a label or of a view's name


def unprintable(text: str, allowed: str = "") -> bool:
    """True where text holds control characters, line ends or lone surrogates, the allowed apart."""
    return any(
        unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") and c not in allowed for c in text
    )


def check_names(names: Any, what: str, where: object, remedy: str) -> None:
    """Raise InputError unless `names` is a list of different names; they may hold line ends."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{where}: {what} are no list of names; {remedy}")
    for name in names:
        if not name.strip() or len(name) > LONGEST or unprintable(name, "\n\t"):
            raise InputError(
                f"{where}: {what}: {name[:40]!r} is no usable name: empty, longer than {LONGEST} "
                "characters, or with "
                f"characters that cannot be printed; {remedy}"
            )
    for name, count in Counter(names).most_common(1):
        if count > 1:
            raise InputError(f"{where}: {what}: {name!r} occurs {count} times; {remedy}")


def suggest(word: str, vocabulary: Iterable[str], n: int = 3) -> list[str]:
    """At most `n` words of the vocabulary that look most like a word, best first."""
    return difflib.get_close_matches(word[:LONGEST], list(vocabulary), n)


def natural(name: str) -> tuple[Any, ...]:
    """Sort key that puts frame_2 before frame_10; equal numbers differ by their spelling."""
    parts = re.split(r"(\d+)", name)
    return tuple(int(part) if k % 2 else part for k, part in enumerate(parts)), name


def few(names: Iterable[str]) -> str:
    """The first three of some names, for a message, and an ellipsis if there are more."""
    ordered = sorted(names, key=natural)
    printable = [f"{name!a}"[1:-1] if unprintable(name) else name for name in ordered[:3]]
    return ", ".join(printable) + ", ..." * (len(ordered) > 3)
