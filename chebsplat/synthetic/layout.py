"""Whole rooms: their furniture, materials and light; and the seeds reserved for each use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chebsplat.synthetic import furniture as put
from chebsplat.synthetic.mesh import Builder, Frame, Soup
from chebsplat.synthetic.textures import Material

Tone = Sequence[float] | np.ndarray  # red, green, blue; linear, in [0, 1]
WHITE = (0.78, 0.77, 0.74)
SCENES = range(1000)  # named scenes and tests
REFERENCE = range(8000, 8100)  # views that a teacher's channels are computed from
# the embedded teacher is measured on these: the first half offices, the others rooms
HELD_OUT = range(9000, 9020)
TRAINING = range(10_000, 20_000)  # the embedded teacher is trained on these
KNOWLEDGE = range(20_000, 21_000)  # knowledge is taught on these
MODELLED = range(22_000, 23_000)  # and on these, which are furnished with modelled pieces


@dataclass
class Room:
    """A scene to render: geometry, materials, lights [L, 2, 3] (centre, half extent) in metres."""

    soup: Soup
    materials: list[Material]
    lights: np.ndarray
    size: tuple[float, float, float]


class Palette:
    """Materials of one room, drawn once and shared by pieces of different shape."""

    def __init__(self, rng: np.random.Generator):
        self.table: list[Material] = []
        self.rng = rng
        brown = np.array([0.36, 0.22, 0.12]) * rng.uniform(0.8, 1.5)
        self.wood = self.add("wood", brown, 0.55 * brown, 0.12, 0.12)
        pale = np.array([0.62, 0.48, 0.32]) * rng.uniform(0.85, 1.1)
        self.pale_wood = self.add("wood", pale, 0.75 * pale, 0.16, 0.08)
        self.metal = self.add("plain", (0.3, 0.3, 0.32), gloss=0.35, shininess=40)
        self.dark = self.add("plain", (0.05, 0.05, 0.06), gloss=0.15, shininess=30)
        self.white = self.add("plain", WHITE, gloss=0.05)
        self.matt_white = self.add("plain", WHITE)
        self.screen = self.add("cloud", (0.05, 0.12, 0.3), (0.02, 0.03, 0.08), 0.25, 0.4, 60)
        self.glass = self.add("cloud", (0.6, 0.75, 0.9), (0.42, 0.58, 0.8), 0.8, 0.2, 60)
        self.slat = self.add("plain", np.array([0.7, 0.68, 0.6]) * rng.uniform(0.8, 1.0))
        self.green = self.add("stripes", (0.12, 0.34, 0.08), (0.07, 0.22, 0.05), 0.07, 0.06, 20)
        self.keys = self.add("check", (0.16, 0.16, 0.17), (0.05, 0.05, 0.05), 0.05)
        self.fabric = self.add("cloud", *self.two_tones(0.25), 0.06)
        self.other_fabric = self.add("check", *self.two_tones(0.3), 0.12)
        self.books = [self.add("stripes", *self.two_tones(0.35), 0.15) for _ in range(6)]

    def add(
        self,
        pattern: str,
        first: Tone,
        second: Tone = (0.0, 0.0, 0.0),
        scale: float = 0.2,
        gloss: float = 0.0,
        shininess: float = 30.0,
    ) -> int:
        """A material's index in the table."""
        seed = int(self.rng.integers(2**20))
        a, b = ((float(tone[0]), float(tone[1]), float(tone[2])) for tone in (first, second))
        self.table.append(Material(pattern, a, b, scale, gloss, shininess, seed))
        return len(self.table) - 1

    def two_tones(self, level: float) -> tuple[np.ndarray, np.ndarray]:
        """A saturated tone and a darker or paler one."""
        tone = self.rng.uniform(0.15, 1.0, 3) ** 1.5 * level * 2
        return tone, np.clip(tone * self.rng.uniform(0.4, 0.8) + self.rng.uniform(0, 0.1), 0, 0.9)


def shell(
    b: Builder, p: Palette, rng: np.random.Generator, size: tuple[float, float, float]
) -> None:
    """Floor, ceiling and four walls; the walls range from plain to patterned."""
    w, d, h = size
    floor = p.add("planks", (0.5, 0.36, 0.22), (0.28, 0.18, 0.1), 0.14, 0.15, 40)
    if rng.random() < 0.4:
        floor = p.add("tiles", (0.3, 0.3, 0.3), (0.55, 0.53, 0.5), 0.4, 0.2, 40)
    tint = np.array(WHITE) * rng.uniform(0.85, 1.0, 3)
    papers = [
        p.matt_white,
        p.add("cloud", tint, 0.86 * tint, 0.5),
        p.add("stripes", tint, 0.8 * tint, 0.3),
    ]
    room = Frame((0.0, 0.0, 0.0))
    b.box("floor", floor, room, (-0.1, -0.1, -0.1), (w + 0.1, d + 0.1, 0))
    ceiling = p.add("cloud", WHITE, tuple(0.9 * v for v in WHITE), 0.9)
    b.box("ceiling", ceiling, room, (-0.1, -0.1, h), (w + 0.1, d + 0.1, h + 0.1))
    walls = [((-0.1, -0.1, 0), (w + 0.1, 0, h)), ((-0.1, d, 0), (w + 0.1, d + 0.1, h)),
             ((-0.1, 0, 0), (0, d, h)), ((w, 0, 0), (w + 0.1, d, h))]  # fmt: skip
    for low, high in walls:
        b.box("wall", papers[int(rng.integers(3))], room, low, high)


def build(preset: str, seed: int) -> Room:
    """The room of a preset and a seed. Raises KeyError on an unknown preset."""
    rng = np.random.default_rng(seed)
    small = preset == "toy"
    size = (3.4, 2.8, 2.5) if small else (rng.uniform(4.7, 5.3), rng.uniform(3.8, 4.2), 2.7)
    b, p = Builder(), Palette(rng)
    shell(b, p, rng, size)
    {"office": office, "room": living_room, "toy": toy}[preset](b, p, rng, size)
    w, d, h = size
    lights = np.array(
        [
            [[w * 0.35, d * 0.5, h - 0.05], [0.5, 0.3, 0]],
            [[w * 0.75, d * 0.45, h - 0.05], [0.3, 0.5, 0]],
        ]
    )
    return Room(b.soup(), p.table, lights, size)


def south(w: float, d: float, x: float, z: float = 0.0) -> Frame:
    """On the wall y = 0, facing the room."""
    return Frame((x, 0.0, z))


def north(w: float, d: float, x: float, z: float = 0.0) -> Frame:
    return Frame((x, d, z), np.pi)


def west(w: float, d: float, y: float, z: float = 0.0) -> Frame:
    return Frame((0.0, y, z), -np.pi / 2)


def east(w: float, d: float, y: float, z: float = 0.0) -> Frame:
    return Frame((w, y, z), np.pi / 2)


def office(
    b: Builder, p: Palette, rng: np.random.Generator, size: tuple[float, float, float]
) -> None:
    w, d, _ = size
    x = w * 0.3 + rng.uniform(-0.1, 0.1)
    workplace(b, p, rng, south(w, d, x))
    put.window(b, south(w, d, w * 0.72), p.white, p.glass, p.slat, 1.3, rng.uniform(0.3, 0.7))
    put.cabinet(b, south(w, d, w * 0.72), p.pale_wood, p.metal, 1.2, 0.8)
    put.plant(b, south(w, d, w * 0.72 - 0.3, 0.8), p.matt_white, p.green, rng, 0.4, 0.1)
    put.shelf(b, east(w, d, d * 0.62), p.wood, p.books, rng, 1.0, 1.9)
    put.plant(b, east(w, d, d * 0.28), p.add("plain", (0.45, 0.2, 0.12)), p.green, rng)
    seat = north(w, d, w * 0.55 + rng.uniform(-0.1, 0.1))
    put.sofa(b, seat, p.fabric, (p.other_fabric, p.add("dots", *p.two_tones(0.4), 0.1)))
    put.picture(
        b, seat.moved(0, 0, 1.55), p.wood, p.add("painting", *p.two_tones(0.4), 0.25), 0.9, 0.6
    )
    put.clock(b, north(w, d, w * 0.86, 1.75), p.metal, p.matt_white, p.dark)
    put.floor_lamp(b, north(w, d, w * 0.26).moved(0, 0.3, 0), p.metal, p.matt_white)
    put.door(b, west(w, d, d * 0.7), p.pale_wood, p.white)
    put.picture(
        b, west(w, d, d * 0.3, 1.5), p.dark, p.add("painting", *p.two_tones(0.4), 0.2), 0.5, 0.65
    )
    meeting(b, p, rng, Frame((w * 0.56, d * 0.47, 0), rng.uniform(-0.2, 0.2)))


def workplace(b: Builder, p: Palette, rng: np.random.Generator, f: Frame) -> None:
    """A desk with what lies on it, its chair and a bin."""
    put.desk(b, f, p.wood, p.metal)
    put.monitor(b, f.moved(-0.15, 0.05, 0.74, rng.uniform(-0.15, 0.15)), p.dark, p.screen)
    put.keyboard(b, f.moved(-0.15, 0.45, 0.74), p.keys)
    put.desk_lamp(b, f.moved(-0.58, 0.2, 0.74), p.metal, p.matt_white)
    put.lying_books(b, f.moved(0.45, 0.35, 0.74), p.books, rng)
    put.office_chair(b, f.moved(-0.1, 1.35, 0, np.pi + rng.uniform(-0.4, 0.4)), p.metal, p.fabric)
    put.bin_(b, f.moved(0.95, 0.05, 0), p.dark)


def meeting(b: Builder, p: Palette, rng: np.random.Generator, f: Frame) -> None:
    """A table and chairs of the same wood on a rug."""
    put.rug(b, f.moved(0, 0, 0), p.add("rings", *p.two_tones(0.3), 0.25), 1.9, 1.4)
    put.table(b, f.moved(0, -0.3, 0), p.wood, 1.0, 0.6, 0.72)
    put.chair(b, f.moved(0.12, 0.85, 0, np.pi + rng.uniform(-0.3, 0.3)), p.wood, p.other_fabric)
    put.chair(b, f.moved(-1.0, 0.1, 0, -np.pi / 2 + rng.uniform(-0.3, 0.3)), p.wood, p.other_fabric)
    put.lying_books(b, f.moved(0.2, 0.0, 0.72), p.books, rng)


def living_room(
    b: Builder, p: Palette, rng: np.random.Generator, size: tuple[float, float, float]
) -> None:
    w, d, _ = size
    seat = north(w, d, w * 0.45)
    put.sofa(b, seat, p.fabric, (p.other_fabric, p.add("dots", *p.two_tones(0.4), 0.1)), 2.1)
    put.picture(
        b, seat.moved(-0.5, 0, 1.6), p.dark, p.add("painting", *p.two_tones(0.4), 0.25), 0.6, 0.6
    )
    put.picture(
        b, seat.moved(0.4, 0, 1.6), p.wood, p.add("painting", *p.two_tones(0.4), 0.18), 0.8, 0.5
    )
    put.floor_lamp(b, north(w, d, w * 0.8).moved(0, 0.3, 0), p.metal, p.matt_white)
    put.cabinet(b, south(w, d, w * 0.42), p.wood, p.metal, 1.6, 0.6)
    put.monitor(b, south(w, d, w * 0.42, 0.6), p.dark, p.screen, 0.95)
    put.shelf(b, south(w, d, w * 0.8), p.pale_wood, p.books, rng, 0.9, 1.9)
    put.bin_(b, south(w, d, w * 0.62), p.metal)
    put.window(b, east(w, d, d * 0.5), p.white, p.glass, p.slat, 1.5, rng.uniform(0.3, 0.7))
    put.desk(b, east(w, d, d * 0.5), p.pale_wood, p.metal, 1.2, 0.6)
    put.keyboard(b, east(w, d, d * 0.5, 0.74).moved(0, 0.3, 0), p.keys)
    put.desk_lamp(b, east(w, d, d * 0.5, 0.74).moved(0.4, 0.2, 0), p.metal, p.other_fabric)
    put.door(b, west(w, d, d * 0.3), p.wood, p.white)
    put.clock(b, west(w, d, d * 0.65, 1.8), p.dark, p.matt_white, p.dark)
    put.plant(b, west(w, d, d * 0.85).moved(0, 0, 0), p.matt_white, p.green, rng, 1.0)
    meeting(b, p, rng, Frame((w * 0.5, d * 0.47, 0), rng.uniform(-0.2, 0.2)))


def toy(b: Builder, p: Palette, rng: np.random.Generator, size: tuple[float, float, float]) -> None:
    w, d, _ = size
    put.cabinet(b, south(w, d, w * 0.3), p.pale_wood, p.metal, 1.0, 0.9)
    put.floor_lamp(b, south(w, d, w * 0.75).moved(0, 0.3, 0), p.metal, p.matt_white)
    put.picture(
        b, north(w, d, w * 0.5, 1.5), p.wood, p.add("painting", *p.two_tones(0.4), 0.25), 1.0, 0.7
    )
    put.chair(b, Frame((w * 0.55, d * 0.75, 0), np.pi), p.wood, p.other_fabric)
    put.table(b, Frame((w * 0.5, d * 0.4, 0)), p.wood, 0.9, 0.5, 0.6)
