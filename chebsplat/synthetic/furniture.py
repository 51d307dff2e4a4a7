"""Furniture from parametric solids, each at its frame's origin: back at local y = 0, facing +y."""

from __future__ import annotations

import numpy as np

from chebsplat.synthetic.mesh import Builder, Frame

Generator = np.random.Generator


def legs(
    b: Builder,
    label: str,
    material: int,
    f: Frame,
    width: float,
    depth: float,
    top: float,
    side: float,
) -> None:
    """Four square legs at the corners of a width x depth top."""
    for x in (-width / 2, width / 2 - side):
        for y in (0.0, depth - side):
            b.box(label, material, f, (x, y, 0), (x + side, y + side, top))


def desk(
    b: Builder, f: Frame, wood: int, metal: int, width: float = 1.4, depth: float = 0.7
) -> None:
    b.box("desk", wood, f, (-width / 2, 0, 0.70), (width / 2, depth, 0.74))
    legs(b, "desk", metal, f, width, depth, 0.70, 0.05)
    b.box("desk", wood, f, (width / 2 - 0.45, 0.05, 0.12), (width / 2 - 0.06, depth - 0.05, 0.68))
    for z in (0.30, 0.49):
        b.box(
            "desk",
            metal,
            f,
            (width / 2 - 0.33, depth - 0.05, z),
            (width / 2 - 0.18, depth - 0.03, z + 0.02),
        )


def monitor(b: Builder, f: Frame, frame: int, screen: int, width: float = 0.56) -> None:
    height = 0.6 * width
    b.box("monitor", frame, f, (-0.12, 0.02, 0), (0.12, 0.2, 0.015))
    b.box("monitor", frame, f, (-0.02, 0.08, 0), (0.02, 0.11, 0.22))
    b.box("monitor", frame, f, (-width / 2, 0.11, 0.12), (width / 2, 0.15, 0.12 + height))
    b.box(
        "monitor",
        screen,
        f,
        (-width / 2 + 0.02, 0.15, 0.14),
        (width / 2 - 0.02, 0.153, 0.10 + height),
    )


def keyboard(b: Builder, f: Frame, material: int) -> None:
    b.box("keyboard", material, f, (-0.22, 0, 0), (0.22, 0.15, 0.025))


def desk_lamp(b: Builder, f: Frame, metal: int, shade: int) -> None:
    b.revolved("lamp", metal, f, [(0.08, 0), (0.08, 0.02), (0.012, 0.03), (0.012, 0.36)])
    b.revolved("lamp", shade, f.moved(0, 0, 0.34), [(0.11, 0), (0.05, 0.13), (0.02, 0.14)])


def floor_lamp(b: Builder, f: Frame, metal: int, shade: int) -> None:
    b.revolved("lamp", metal, f, [(0.14, 0), (0.14, 0.025), (0.015, 0.04), (0.015, 1.4)])
    b.revolved("lamp", shade, f.moved(0, 0, 1.32), [(0.19, 0), (0.13, 0.27), (0.03, 0.28)])


def table(b: Builder, f: Frame, wood: int, width: float, depth: float, height: float) -> None:
    b.box("table", wood, f, (-width / 2, 0, height - 0.04), (width / 2, depth, height))
    legs(b, "table", wood, f, width, depth, height - 0.04, 0.06)


def chair(b: Builder, f: Frame, wood: int, fabric: int) -> None:
    """A chair with the legs of the table's wood: same texture, another shape."""
    b.box("chair", fabric, f, (-0.21, 0, 0.43), (0.21, 0.42, 0.48))
    legs(b, "chair", wood, f, 0.42, 0.42, 0.43, 0.04)
    for x in (-0.21, 0.17):
        b.box("chair", wood, f, (x, 0, 0.48), (x + 0.04, 0.04, 0.92))
    b.box("chair", fabric, f, (-0.19, 0.005, 0.62), (0.19, 0.035, 0.9))


def office_chair(b: Builder, f: Frame, metal: int, fabric: int) -> None:
    for k in range(5):
        b.box(
            "chair",
            metal,
            f.moved(0, 0.22, 0, 2 * np.pi * k / 5),
            (-0.02, 0, 0.03),
            (0.02, 0.28, 0.07),
        )
    b.revolved("chair", metal, f.moved(0, 0.22, 0), [(0.03, 0.05), (0.03, 0.44)], 12)
    b.box("chair", fabric, f, (-0.23, 0, 0.44), (0.23, 0.45, 0.52))
    b.box("chair", metal, f, (-0.03, -0.02, 0.5), (0.03, 0.01, 0.7))
    b.box("chair", fabric, f, (-0.21, -0.04, 0.62), (0.21, 0.02, 1.05))


def sofa(b: Builder, f: Frame, fabric: int, cushion: tuple[int, int], width: float = 1.8) -> None:
    b.box("sofa", fabric, f, (-width / 2, 0, 0.08), (width / 2, 0.8, 0.26))
    b.box("sofa", fabric, f, (-width / 2, 0, 0.26), (width / 2, 0.2, 0.78))
    for x in (-width / 2, width / 2 - 0.16):
        b.box("sofa", fabric, f, (x, 0.2, 0.26), (x + 0.16, 0.8, 0.56))
    inner = (width - 0.32) / 2
    for k in range(2):
        x = -width / 2 + 0.16 + k * inner
        b.box("sofa", fabric, f, (x + 0.01, 0.2, 0.26), (x + inner - 0.01, 0.82, 0.42))
        side = 0.28 if k == 0 else inner - 0.28
        b.pillow(
            "cushion", cushion[k], f.moved(x + side, 0.3, 0.42, 0.25 - 0.5 * k), (0.42, 0.18, 0.4)
        )


def cabinet(
    b: Builder, f: Frame, body: int, metal: int, width: float, height: float, depth: float = 0.45
) -> None:
    b.box("cabinet", body, f, (-width / 2, 0, 0.06), (width / 2, depth, height))
    b.box("cabinet", metal, f, (-width / 2 + 0.03, 0.03, 0), (width / 2 - 0.03, depth - 0.03, 0.06))
    n = max(2, round(width / 0.5))
    for k in range(n):
        x = -width / 2 + k * width / n
        b.box(
            "cabinet",
            body,
            f,
            (x + 0.015, depth, 0.09),
            (x + width / n - 0.015, depth + 0.02, height - 0.03),
        )
        handle = x + width / n - 0.07 if k % 2 == 0 else x + 0.05
        b.box(
            "cabinet",
            metal,
            f,
            (handle, depth + 0.02, 0.55 * height),
            (handle + 0.02, depth + 0.045, 0.72 * height),
        )


def shelf(
    b: Builder, f: Frame, wood: int, books: list[int], rng: Generator, width: float, height: float
) -> None:
    """An open shelf, part filled with books."""
    depth, thick = 0.3, 0.025
    for x in (-width / 2, width / 2 - thick):
        b.box("shelf", wood, f, (x, 0, 0), (x + thick, depth, height))
    b.box("shelf", wood, f, (-width / 2, 0, 0), (width / 2, 0.012, height))
    n = round(height / 0.38)
    for k in range(n + 1):
        z = 0.04 + k * (height - 0.04 - thick) / n
        b.box("shelf", wood, f, (-width / 2, 0, z), (width / 2, depth, z + thick))
        if k < n and rng.random() < 0.85:
            start = -width / 2 + 0.04 + rng.uniform(0, 0.25) * width
            row_of_books(
                b, f.moved(start, 0.03, z + thick), books, rng, rng.uniform(0.35, 0.6) * width
            )


def row_of_books(b: Builder, f: Frame, books: list[int], rng: Generator, length: float) -> None:
    x = 0.0
    while x < length:
        thickness, height = rng.uniform(0.025, 0.06), rng.uniform(0.18, 0.28)
        b.box(
            "book",
            int(rng.choice(books)),
            f,
            (x, 0, 0),
            (x + thickness, rng.uniform(0.14, 0.2), height),
        )
        x += thickness + 0.002


def lying_books(b: Builder, f: Frame, books: list[int], rng: Generator) -> None:
    z = 0.0
    for _ in range(int(rng.integers(2, 4))):
        thickness = rng.uniform(0.02, 0.045)
        turned = f.moved(0, 0, z, rng.uniform(-0.3, 0.3))
        b.box("book", int(rng.choice(books)), turned, (-0.13, -0.09, 0), (0.13, 0.09, thickness))
        z += thickness


def bin_(b: Builder, f: Frame, material: int) -> None:
    b.revolved(
        "bin", material, f.moved(0, 0.16, 0), [(0.11, 0), (0.15, 0.36), (0.14, 0.36), (0.105, 0.03)]
    )


def plant(
    b: Builder,
    f: Frame,
    pot: int,
    green: int,
    rng: Generator,
    height: float = 0.9,
    behind: float = 0.19,
) -> None:
    """Leaves to all sides, but growing steeply where the wall is only `behind` metres away."""
    middle = f.moved(0, 0.22, 0)
    b.revolved("plant", pot, middle, [(0.11, 0), (0.16, 0.3), (0.14, 0.3), (0.13, 0.26)])
    for k in range(16):
        turn = 2 * np.pi * k * 0.382
        length, width, bend = (
            height * rng.uniform(0.6, 1.0),
            rng.uniform(0.09, 0.14),
            rng.uniform(0.5, 1.0),
        )
        free = (behind - 0.5 * width * abs(np.sin(turn))) / max(-np.cos(turn), 1e-6)
        reach = min(0.55 * length, max(free, 0.05))
        b.leaf("plant", green, middle.moved(0, 0, 0.25, turn), length, reach, width, bend)


def rug(b: Builder, f: Frame, material: int, width: float, depth: float) -> None:
    b.box("rug", material, f, (-width / 2, -depth / 2, 0), (width / 2, depth / 2, 0.012))


def clock(b: Builder, f: Frame, rim: int, face: int, dark: int) -> None:
    """On a wall at its frame's height; the wall is at y = 0."""
    for k in range(24):
        spoke = Frame(f.origin, f.yaw)
        angle = 2 * np.pi * k / 24
        x, z = 0.15 * np.cos(angle), 0.15 * np.sin(angle)
        b.box("clock", rim, spoke, (x - 0.022, 0, z - 0.022), (x + 0.022, 0.04, z + 0.022))
    for k in range(8):
        half = 0.15 * np.cos(np.pi / 16 * (2 * k - 7))
        low = -0.15 + 0.3 * k / 8
        b.box("clock", face, f, (low, 0, -half), (low + 0.3 / 8, 0.02, half))
    b.box("clock", dark, f, (-0.008, 0.02, 0), (0.008, 0.028, 0.11))
    b.box("clock", dark, f, (0, 0.02, -0.008), (0.07, 0.028, 0.008))


def picture(b: Builder, f: Frame, frame: int, canvas: int, width: float, height: float) -> None:
    """On a wall at its frame's height; the wall is at y = 0."""
    b.box("picture", frame, f, (-width / 2, 0, -height / 2), (width / 2, 0.025, height / 2))
    inset = 0.04
    x, z = width / 2 - inset, height / 2 - inset
    b.box("picture", canvas, f, (-x, 0.025, -z), (x, 0.03, z))


def door(b: Builder, f: Frame, wood: int, metal: int) -> None:
    b.box("door", wood, f, (-0.45, 0, 0), (0.45, 0.04, 2.03))
    for x in (-0.52, 0.45):
        b.box("door", metal, f, (x, 0, 0), (x + 0.07, 0.06, 2.1))
    b.box("door", metal, f, (-0.52, 0, 2.03), (0.52, 0.06, 2.1))
    b.box("door", metal, f, (0.32, 0.04, 1.0), (0.41, 0.09, 1.03))


def window(
    b: Builder, f: Frame, white: int, glass: int, slat: int, width: float, closed: float
) -> None:
    """A window from 0.9 to 2.2 m, its blinds let down over the share `closed`."""
    b.box("window", glass, f, (-width / 2, 0, 0.9), (width / 2, 0.01, 2.2))
    for x in (-width / 2 - 0.05, -0.025, width / 2):
        b.box("window", white, f, (x, 0, 0.85), (x + 0.05, 0.05, 2.25))
    for z in (0.85, 2.2):
        b.box("window", white, f, (-width / 2 - 0.05, 0, z), (width / 2 + 0.05, 0.05, z + 0.05))
    n = round(closed * 1.3 / 0.06)
    b.box("blinds", slat, f, (-width / 2, 0.06, 2.2), (width / 2, 0.11, 2.26))
    for k in range(n):
        z = 2.17 - 0.06 * k
        b.box(
            "blinds",
            slat,
            f,
            (-width / 2, 0.065 + 0.01 * (k % 2), z - 0.045),
            (width / 2, 0.085, z),
        )
