"""Rooms by the name of their preset: those with a layout of their own, and those furnished at random."""

from __future__ import annotations

from chebsplat.synthetic import layout
from chebsplat.synthetic.shuffled import shuffled


def build(preset: str, seed: int) -> layout.Room:
    """The room of a preset (`office`, `room`, `toy`, `shuffled`) and a seed. Raises KeyError on another preset."""
    return shuffled(seed) if preset == "shuffled" else layout.build(preset, seed)
