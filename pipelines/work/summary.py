"""What a scene has come to, in a few lines: read from manifests and figures, without torch."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.documents import read_document


def figures(evaluation: Path) -> Any:
    """What an evaluation measured; None where there is none, or it is damaged (`chebsplat verify` says how)."""
    try:
        return read_document(evaluation, artifact.read_manifest(evaluation), "figures.json")
    except InputError:
        return None


def number(figures: Any, *keys: str) -> float | None:
    """A figure by its keys; None if it was not measured."""
    for key in keys:
        figures = figures.get(key) if isinstance(figures, dict) else None
    return figures if isinstance(figures, int | float) and math.isfinite(figures) else None


def text(form: str, value: float | None) -> str:
    """A value in a format, empty for None."""
    return "" if value is None else form.format(value)


def quality(figures: Any) -> tuple[str, str, str]:
    """(test PSNR, mIoU, its 2D teacher's mIoU); empty where they were not measured."""
    shares = (number(figures, "segmentation", whose, "miou") for whose in ("scene", "teacher"))
    miou, teacher = (text("{:.1%}", share) for share in shares)
    return text("{:.1f} dB", number(figures, "image", "psnr")), miou, teacher


def table(evaluation: Path) -> list[tuple[str, str, str]]:
    """(what, value, beside it) of a scene that was evaluated; what was not measured is not there."""
    measured = figures(evaluation)
    psnr, miou, teacher = quality(measured)
    size = {name: text("{:.1f} MB", scaled(number(measured, "bytes", name))) for name in ("ply", "split", "ragged")}
    others = ", ".join(f"{name} {shown}" for name, shown in size.items() if shown and name != "ply")
    rows = [
        ("test PSNR", psnr, text("SSIM {:.3f}", number(measured, "image", "ssim"))),
        ("mIoU", miou, f"its 2D teacher {teacher}" if teacher else ""),
        ("Gaussians", text("{:,}", number(measured, "n_gaussians")), ""),
        ("PLY", size["ply"], others),
        ("frames/s", text("{:.0f}", number(measured, "frames_per_second", "color")), "colour alone"),
    ]
    return [row for row in rows if row[1]]


def scaled(size: float | None) -> float | None:
    """Bytes as MB."""
    return None if size is None else size / 1e6


def readable(path: Path) -> str:
    """A path as a user who stands here would type it."""
    here = Path.cwd()
    return os.path.relpath(path, here) if path.is_relative_to(here) else str(path)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines, every column as wide as its widest cell."""
    if not rows:
        return []
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def show_rows(rows: Sequence[Sequence[str]]) -> None:
    """Print rows in aligned columns."""
    for line in aligned(rows):
        print(line)
