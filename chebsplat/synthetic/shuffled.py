"""Rooms furnished at random, with other materials and light: no two of them share a layout.

Choices: pieces stand in any order along the walls, with a gap between them; what a room holds
  follows its size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from chebsplat.synthetic import furniture as put
from chebsplat.synthetic import layout
from chebsplat.synthetic.mesh import Builder, Frame
from chebsplat.synthetic.textures import PATTERNS

Generator = np.random.Generator


def jitter(room: layout.Room, rng: Generator) -> None:
    """Give half of the materials other colours, some another pattern too, and move the lights."""
    patterns = ["plain", *PATTERNS]
    for index, material in enumerate(room.materials):
        if rng.random() < 0.5:
            tone = np.clip(
                rng.uniform(0.02, 0.95) * (1 + rng.uniform(-0.5, 0.5, 3) * rng.random()), 0.02, 0.9
            )
            other = np.clip(tone * rng.uniform(0.4, 1.2, 3), 0.01, 0.9)
            first, second = ((float(c[0]), float(c[1]), float(c[2])) for c in (tone, other))
            material = replace(
                material, first=first, second=second, gloss=material.gloss * rng.uniform(0, 1.5)
            )
        if rng.random() < 0.25:
            pattern = str(rng.choice(patterns))
            material = replace(
                material,
                pattern=pattern,
                scale=float(np.exp(rng.uniform(np.log(0.05), np.log(0.7)))),
            )
        room.materials[index] = material
    room.lights[:, 0, :2] += rng.uniform(-0.6, 0.6, (len(room.lights), 2))
    if rng.random() < 0.25:
        room.lights = room.lights[:1]


def shuffled(seed: int) -> layout.Room:
    """A room of any size whose furniture stands in any order along any wall."""
    rng = np.random.default_rng([seed, 3])
    size = (rng.uniform(3.6, 7.0), rng.uniform(3.4, 6.0), rng.uniform(2.4, 3.1))
    w, d, h = size
    b, p = Builder(), layout.Palette(rng)
    layout.shell(b, p, rng, size)
    for wall, length in ((layout.south, w), (layout.north, w), (layout.west, d), (layout.east, d)):
        at = rng.uniform(0.85, 1.1)
        for index in rng.integers(len(PIECES), size=12):
            piece, width = PIECES[index][0], PIECES[index][1] * rng.uniform(0.9, 1.2)
            if at + width < length - 0.85:
                piece(b, p, rng, wall(w, d, at + width / 2), width)
                at += width + rng.uniform(0.05, 0.4)
    if min(w, d) > 3.9:
        middle = Frame(
            (w * rng.uniform(0.45, 0.55), d * rng.uniform(0.45, 0.55), 0),
            rng.uniform(-np.pi, np.pi),
        )
        layout.meeting(b, p, rng, middle)
    centres = np.stack(
        [rng.uniform(0.2, 0.8, 2) * w, rng.uniform(0.3, 0.7, 2) * d, np.full(2, h - 0.05)], 1
    )
    halves = np.concatenate([rng.uniform(0.2, 0.6, (2, 2)), np.zeros((2, 1))], 1)
    return layout.Room(b.soup(), p.table, np.stack([centres, halves], 1), size)


def _any(p: layout.Palette, rng: Generator) -> int:
    """A material for a body: wood mostly, or anything plain."""
    return int(rng.choice([p.wood, p.pale_wood, p.white, p.matt_white, p.dark, p.metal]))


def _above(b: Builder, p: layout.Palette, rng: Generator, f: Frame) -> None:
    """A picture or a clock on the wall, or nothing."""
    chance, high = rng.random(), f.moved(rng.uniform(-0.3, 0.3), 0, rng.uniform(1.6, 1.85))
    if chance < 0.4:
        canvas = p.add("painting", *p.two_tones(0.4), rng.uniform(0.15, 0.3))
        put.picture(b, high, _any(p, rng), canvas, rng.uniform(0.4, 1.0), rng.uniform(0.35, 0.7))
    elif chance < 0.65:
        put.clock(b, high, _any(p, rng), p.matt_white, p.dark)


def _upon(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    """Things on a top."""
    for x in np.arange(-width / 2 + 0.25, width / 2 - 0.2, 0.5):
        spot = f.moved(x + rng.uniform(-0.05, 0.05), 0.05, 0)
        match int(rng.integers(7)):
            case 0:
                put.monitor(b, spot, p.dark, p.screen, rng.uniform(0.42, 0.5))
            case 1:
                put.keyboard(b, spot.moved(0, 0.1, 0), p.keys)
            case 2:
                put.desk_lamp(
                    b,
                    spot.moved(0, 0.12, 0),
                    p.metal,
                    int(rng.choice([p.matt_white, p.other_fabric])),
                )
            case 3:
                put.lying_books(b, spot.moved(0, 0.15, 0), p.books, rng)
            case 4:
                put.plant(b, spot.moved(0, -0.02, 0), _any(p, rng), p.green, rng, 0.4, 0.1)
            case 5:
                put.row_of_books(b, spot.moved(-0.1, 0.05, 0), p.books, rng, 0.25)


def _cabinet(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    height = rng.uniform(0.45, 1.1)
    put.cabinet(b, f, _any(p, rng), p.metal, width, height)
    _upon(b, p, rng, f.moved(0, 0, height), width)
    _above(b, p, rng, f)


def _tall_cabinet(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    put.cabinet(b, f, _any(p, rng), p.metal, width, rng.uniform(1.6, 2.2))


def _desk(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    if rng.random() < 0.5:
        layout.workplace(b, p, rng, f)
        return
    put.desk(b, f, _any(p, rng), p.metal, width, 0.6)
    _upon(b, p, rng, f.moved(0, 0, 0.74), width)
    put.office_chair(
        b,
        f.moved(rng.uniform(-0.2, 0.2), 1.25, 0, np.pi + rng.uniform(-0.6, 0.6)),
        p.metal,
        p.fabric,
    )


def _table(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    height = rng.uniform(0.4, 0.78)
    put.table(b, f, _any(p, rng), width, rng.uniform(0.5, 0.7), height)
    _upon(b, p, rng, f.moved(0, 0, height), width)


def _sofa(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    put.sofa(b, f, p.fabric, (p.other_fabric, p.add("dots", *p.two_tones(0.4), 0.1)), width)
    _above(b, p, rng, f)


def _shelf(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    put.shelf(b, f, _any(p, rng), p.books, rng, width, rng.uniform(1.0, 2.1))


def _window(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    put.window(b, f, p.white, p.glass, p.slat, width - 0.1, rng.uniform(0.0, 0.9))


def _door(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    put.door(b, f, _any(p, rng), int(rng.choice([p.white, p.metal, p.wood])))


def _small(b: Builder, p: layout.Palette, rng: Generator, f: Frame, width: float) -> None:
    """A lamp, plant, bin or chair at the wall."""
    match int(rng.integers(4)):
        case 0:
            put.floor_lamp(
                b, f.moved(0, 0.25, 0), p.metal, int(rng.choice([p.matt_white, p.other_fabric]))
            )
        case 1:
            put.plant(b, f, _any(p, rng), p.green, rng, rng.uniform(0.5, 1.1))
        case 2:
            put.bin_(b, f, _any(p, rng))
        case 3:
            put.chair(b, f.moved(0, 0.05, 0, rng.uniform(-0.3, 0.3)), p.wood, p.other_fabric)
    _above(b, p, rng, f)


PIECES = (
    (_cabinet, 1.2), (_tall_cabinet, 0.9), (_desk, 1.4), (_table, 1.0), (_sofa, 1.9),
    (_shelf, 0.95), (_window, 1.3), (_window, 1.7), (_door, 1.1),
    (_small, 0.5), (_small, 0.5), (_small, 0.5),
)  # fmt: skip


def build(preset: str, seed: int) -> layout.Room:
    """The room of a preset (`office`, `room`, `toy`, `shuffled`) and seed; else a KeyError."""
    return shuffled(seed) if preset == "shuffled" else layout.build(preset, seed)
