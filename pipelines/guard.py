"""How a command leaves: typed errors become a line on stderr and their exit code."""

from __future__ import annotations

import sys
from typing import Any

from chebsplat.errors import ChebsplatError


def guarded(action: Any) -> None:
    """Run `action() -> int` and leave with its exit code; typed errors become a line and their code."""
    try:
        code = action()
    except ChebsplatError as error:
        print(f"chebsplat: {error}", file=sys.stderr)
        code = error.exit_code
    sys.exit(code)
