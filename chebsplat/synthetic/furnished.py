"""Rooms of modelled furniture: kitchens, living, dining and bedrooms, studies, halls, bathrooms.

Choices: pieces stand along the walls, in rows or wherever there is room, seats about a table in the
  middle, things on tops, lamps under the ceiling; none stands in another, in front of a door or
  where the camera goes. Beds, sinks, toys and the like stand there unlabelled. Doors and windows
  are flattened onto the walls, which have no openings.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from chebsplat.cameras import centers
from chebsplat.errors import InputError
from chebsplat.synthetic import furniture as put
from chebsplat.synthetic import layout
from chebsplat.synthetic.catalogue import Piece, read_catalogue, read_mesh
from chebsplat.synthetic.mesh import Builder, Frame
from chebsplat.synthetic.rays import walk

PIECES = tomllib.loads(Path(__file__).with_name("pieces.toml").read_text())
TOPPED = ("cabinet", "shelf", "table", "desk")  # classes on whose tops things lie
HIGHEST_TOP = 1.3  # m
WIDEST = 3.4  # m, of a piece
WIDEST_THING = 0.75  # m, of one on a top
STEP_FREE = 0.8  # m, before a door
CAMERA_FREE = 0.15  # m, about the places of photos
BOOKS = (0.35, 0.25, 0.1)  # m, of a pile of them
INNER = 0.7  # of a top's sides, where things stand: some tops are round


@dataclass(frozen=True)
class Recipe:
    """A kind of room, by groups of pieces: rows that stand side by side along a wall, a table in
    the middle, one of these, and seats about it; what stands wherever there is room, and what lies
    on tops; the range of its sides in metres.
    """

    rows: tuple[tuple[str, ...], ...]
    tables: tuple[str, ...]
    seats: str
    loose: tuple[str, ...]
    things: tuple[str, ...]
    sides: tuple[float, float]


LIVING = Recipe(
    (("sofa", "floor lamp", "plant", "armchair"),
     ("tv stand", "shelf", "shelf", "plant", "dresser")),
    ("coffee table",), "armchair",
    ("plant", "shelf", "armchair", "floor lamp", "radiator", "bin", "clutter", "desk", "dresser"),
    ("tv", "plant", "thing", "frame", "table lamp", "clock", "book"), (3.4, 6.5),
)  # fmt: skip
KITCHEN = Recipe(
    (("lower", "lower", "lower", "appliance", "sink", "lower", "appliance", "wardrobe"),
     ("lower", "lower", "appliance", "shelf", "dresser")),
    ("table", "table", "bar table"), "chair", ("bin", "plant", "stool", "radiator", "shelf"),
    ("dishes", "dishes", "dishes", "plant", "thing"), (2.6, 5.2),
)  # fmt: skip
BEDROOM = Recipe(
    (("night stand", "bed", "night stand"), ("wardrobe", "wardrobe", "dresser", "plant")),
    (), "chair",
    ("desk", "dresser", "chair", "shelf", "clutter", "armchair", "radiator", "bin", "plant"),
    ("table lamp", "clock", "frame", "book", "plant", "thing", "tv"), (2.9, 5.0),
)  # fmt: skip
STUDY = Recipe(
    (("desk", "desk", "shelf", "dresser", "plant"), ("desk", "shelf", "shelf", "desk")),
    ("table",), "chair", ("shelf", "bin", "plant", "dresser", "office chair", "floor lamp", "sofa"),
    ("table lamp", "thing", "tv", "plant", "book", "frame"), (2.8, 5.5),
)  # fmt: skip
DINING = Recipe(
    (("dresser", "shelf", "plant", "dresser"),), ("table",), "chair",
    ("sofa", "floor lamp", "armchair", "tv stand", "clutter", "shelf", "plant", "radiator"),
    ("dishes", "plant", "thing", "book", "table lamp"), (3.0, 5.5),
)  # fmt: skip
HALL = Recipe(
    (("wardrobe", "shelf", "dresser"),), (), "chair",
    ("shelf", "dresser", "chair", "plant", "radiator", "clutter", "bin", "stool", "coffee table"),
    ("plant", "thing", "frame", "table lamp", "clock"), (2.2, 5.0),
)  # fmt: skip
BATHROOM = Recipe(
    (("sink", "bath", "bath", "dresser"),), (), "chair",
    ("bath", "sink", "radiator", "stool", "bin", "plant", "wardrobe"),
    ("thing", "plant", "frame"), (2.0, 3.6),
)  # fmt: skip
RECIPES = (KITCHEN, LIVING, BEDROOM, STUDY, KITCHEN, DINING, LIVING, HALL, BATHROOM)


class Catalogue:
    """Pieces by group. Raises InputError where the folder has no library, or a group no piece."""

    def __init__(self, folder: Path):
        self.groups: dict[str, list[Piece]] = {group: [] for group in PIECES}
        for piece in read_catalogue(folder):
            for group, rule in PIECES.items():
                low, high = rule.get("heights", (0.0, WIDEST))
                if (
                    re.fullmatch(rule["names"], piece.name)
                    and re.match(rule.get("categories", ""), piece.category)
                    and (rule.get("raised") or not piece.elevation)
                    and low <= piece.size[2] <= high
                    and max(piece.size) <= WIDEST
                ):
                    width, depth, height = piece.size
                    size = (width, min(depth, rule.get("depth", depth)), height)
                    self.groups[group].append(replace(piece, size=size))
        if empty := [group for group, pieces in self.groups.items() if not pieces]:
            raise InputError(
                f"{folder} has no {empty[0]}: apt install sweethome3d-furniture brings all pieces"
            )


def furnished(seed: int, catalogue: Catalogue) -> layout.Room:
    """A room of modelled pieces; the kinds of RECIPES take turns by seed."""
    rng = np.random.default_rng([seed, 7])
    recipe = RECIPES[seed % len(RECIPES)]
    w, d, h = size = (rng.uniform(*recipe.sides), rng.uniform(*recipe.sides), rng.uniform(2.4, 3.0))
    furnishing = Furnishing(catalogue, recipe, rng, size, centers(walk(size, 80, seed)))
    furnishing.furnish()
    centres = np.stack(
        [rng.uniform(0.2, 0.8, 2) * w, rng.uniform(0.3, 0.7, 2) * d, np.full(2, h - 0.05)], 1
    )
    halves = np.concatenate([rng.uniform(0.2, 0.6, (2, 2)), np.zeros((2, 1))], 1)
    lights = np.stack([centres, halves], 1)
    return layout.Room(furnishing.builder.soup(), furnishing.palette.table, lights, size)


class Furnishing:
    """A room while it is furnished, and the boxes that are occupied in it."""

    def __init__(
        self,
        catalogue: Catalogue,
        recipe: Recipe,
        rng: np.random.Generator,
        size: tuple[float, float, float],
        eyes: np.ndarray,
    ):
        self.catalogue, self.recipe, self.rng, self.size = catalogue, recipe, rng, size
        self.eyes = eyes  # [V, 3], of the camera
        self.builder, self.palette = Builder(), layout.Palette(rng)
        self.occupied: list[tuple[np.ndarray, np.ndarray]] = []

    def furnish(self) -> None:
        """Furnish it: doors first, as other pieces must leave them free."""
        rng, recipe = self.rng, self.recipe
        layout.shell(self.builder, self.palette, rng, self.size)
        walls = [int(wall) for wall in rng.permutation(4)]
        for wall in walls[: rng.integers(1, 3)]:
            self.place_door(wall)
        for wall, row in zip(reversed(walls), recipe.rows, strict=False):  # the last have no door
            self.stand_in_row(wall, row, 0.01 if recipe is KITCHEN else 0.5)
        for wall in walls[-2:]:
            self.place_window(wall)
        self.fill_middle()
        for group in [*rng.permutation(recipe.loose), *rng.permutation(recipe.loose)]:
            self.stand_anywhere(str(group))
        for wall in walls:
            self.hang(wall)
        for _ in range(rng.integers(3)):
            lamp, (w, d, h) = self.draw("hanging lamp"), self.size
            where = (w * rng.uniform(0.3, 0.7), d * rng.uniform(0.3, 0.7), h - lamp.size[2])
            if lamp.size[2] < 0.9:
                self.place("hanging lamp", lamp, Frame(where))

    def draw(self, group: str) -> Piece:
        """A piece of a group."""
        pieces = self.catalogue.groups[group]
        return pieces[self.rng.integers(len(pieces))]

    def at_wall(self, wall: int, along: float) -> Frame:
        """A frame on a wall, facing the room."""
        return (layout.south, layout.north, layout.west, layout.east)[wall](
            self.size[0], self.size[1], along
        )

    def length(self, wall: int) -> float:
        """A wall's length in metres."""
        return self.size[0] if wall < 2 else self.size[1]

    def occupy(self, frame: Frame, size: Sequence[float]) -> bool:
        """Take a box at the frame, unless it leaves the room, meets another or the camera."""
        low, high = box_of(frame, size)
        near = (self.eyes > low - CAMERA_FREE) & (self.eyes < high + CAMERA_FREE)
        if near.all(1).any():
            return False
        if (low < -0.03).any() or (high > np.array(self.size) + 0.03).any():
            return False
        if any((low + 0.02 < b).all() and (high - 0.02 > a).all() for a, b in self.occupied):
            return False
        self.occupied.append((low, high))
        return True

    def place(self, group: str, piece: Piece, frame: Frame) -> bool:
        """Put a piece there, in colours of its own, where there is room for it."""
        if not self.occupy(frame, piece.size):
            return False
        self.add(PIECES[group].get("class"), piece, frame)
        return True

    def add(self, label: str | None, piece: Piece, frame: Frame) -> None:
        """Add a piece's triangles, of each material in another tone than the model's."""
        rng, mesh = self.rng, read_mesh(piece)
        for color, triangles in mesh.parts:
            tone = np.clip(
                np.array(color) * rng.uniform(0.5, 1.3) * rng.uniform(0.8, 1.2, 3), 0.01, 0.9
            )
            pattern = str(rng.choice(["cloud", "cloud", "wood", "stripes", "check"]))
            material = self.palette.add(
                pattern, tone, tone * rng.uniform(0.6, 1.0), rng.uniform(0.05, 0.4)
            )
            rows, corners = np.unique(triangles, return_inverse=True)
            vertices = mesh.vertices[rows].astype(float)
            self.builder.add(label, material, frame, vertices, corners.reshape(-1, 3))

    def stand_in_row(self, wall: int, groups: Sequence[str], gap: float) -> None:
        """Pieces side by side along a wall, each as soon as there is room for it; in any order but
        that of night stands at a bed.
        """
        rng, at, end = self.rng, self.rng.uniform(0.05, 0.5), self.length(wall) - 0.05
        for group in groups if "bed" in groups else rng.permutation(groups):
            piece, start = self.draw(str(group)), at + rng.uniform(0, gap)
            for edge in np.arange(start, end - piece.size[0], 0.1):
                if self.stand(str(group), piece, self.at_wall(wall, edge + piece.size[0] / 2)):
                    at = edge + piece.size[0]
                    break

    def stand_anywhere(self, group: str) -> None:
        """A piece at any wall, if three attempts find room."""
        for _ in range(3):
            wall, piece = int(self.rng.integers(4)), self.draw(group)
            half, length = piece.size[0] / 2, self.length(wall)
            if 2 * half + 0.1 < length:
                along = self.rng.uniform(half + 0.03, length - half - 0.03)
                if self.stand(group, piece, self.at_wall(wall, along)):
                    return

    def stand(self, group: str, piece: Piece, frame: Frame) -> bool:
        """Stand a piece there with what belongs to it; False where there is no room."""
        rng = self.rng
        frame = frame.moved(0, rng.uniform(0, 0.03), piece.elevation)
        if not self.place(group, piece, frame):
            return False
        if group == "desk":
            self.set_up_workplace(piece, frame)
        elif group == "sofa":
            self.lean_cushions(piece, frame)
        elif group == "lower" and rng.random() < 0.7:
            above = "hood" if rng.random() < 0.2 else "upper"
            hung = self.draw(above)
            self.place(above, hung, frame.moved(0, 0, max(hung.elevation, 1.4)))
        if PIECES[group].get("class") in TOPPED:
            self.lay_things(piece, frame)
        return True

    def lay_things(self, piece: Piece, frame: Frame) -> None:
        """Some of the recipe's things, and books, on a piece's top."""
        rng, top = self.rng, piece.top
        if top is None or top > HIGHEST_TOP:
            return
        for group in rng.choice(self.recipe.things, rng.integers(5)):
            thing = self.draw(str(group))
            room = INNER * np.array(piece.size[:2]) - thing.size[:2]
            if max(thing.size) < WIDEST_THING and room.min() > 0:
                x, y = room * rng.uniform(-0.5, 0.5, 2)
                y += (piece.size[1] - thing.size[1]) / 2
                self.place(str(group), thing, frame.moved(x, y, top, rng.uniform(-0.3, 0.3)))
        room = INNER * np.array(piece.size[:2]) - BOOKS[:2]
        if rng.random() < 0.3 and room.min() > 0:
            slide = room[0] * rng.uniform(-0.5, 0.5)
            books = frame.moved(slide, (piece.size[1] - BOOKS[1]) / 2, top)
            if self.occupy(books, BOOKS):
                put.lying_books(self.builder, books, self.palette.books, rng)

    def set_up_workplace(self, desk: Piece, frame: Frame) -> None:
        """A screen, a keyboard and a chair at a desk."""
        rng, palette, width = self.rng, self.palette, self.rng.uniform(0.42, 0.62)
        screen = frame.moved(rng.uniform(-0.2, 0.2), 0.12, desk.size[2])
        if desk.size[2] < 0.9:
            if rng.random() < 0.6 and self.occupy(screen, (width, 0.2, 0.5)):
                put.monitor(self.builder, screen, palette.dark, palette.screen, width)
            if self.occupy(keys := screen.moved(0, 0.27, 0), (0.44, 0.15, 0.03)):
                put.keyboard(self.builder, keys, palette.keys)
        chair = self.draw("office chair")
        away = desk.size[1] + chair.size[1] * rng.uniform(1.05, 1.4)
        seat = frame.moved(rng.uniform(-0.2, 0.2), away, 0, np.pi + rng.uniform(-0.5, 0.5))
        self.place("office chair", chair, seat)

    def lean_cushions(self, sofa: Piece, frame: Frame) -> None:
        """Cushions on a sofa's seat."""
        rng, half = self.rng, sofa.size[0] / 2
        for x in np.arange(0.35 - half, half - 0.3, 0.45):
            if rng.random() < 0.5:
                edge = rng.uniform(0.34, 0.5)
                cover = self.palette.add("check", *self.palette.two_tones(0.4), 0.1)
                seat = frame.moved(x, rng.uniform(0.28, 0.38), 0.49 * sofa.size[2])
                self.builder.pillow("cushion", cover, seat, (edge, 0.14, edge))

    def fill_middle(self) -> None:
        """A rug, and a table with seats about it."""
        rng, (w, d, _), palette = self.rng, self.size, self.palette
        where = (w * rng.uniform(0.38, 0.62), d * rng.uniform(0.35, 0.5), 0.0)
        frame = Frame(where, float(rng.choice([0, np.pi / 2])) + rng.normal(0, 0.06))
        if rng.random() < 0.3:
            rug = self.draw("rug")
            self.add("rug", rug, frame)
        elif rng.random() < 0.6:
            cover = palette.add("rings", *palette.two_tones(0.3), rng.uniform(0.1, 0.4))
            put.rug(self.builder, frame, cover, rng.uniform(1.2, 2.6), rng.uniform(0.9, 1.8))
        if not self.recipe.tables:
            return
        group = str(rng.choice(self.recipe.tables))
        table = self.draw(group)
        if not self.place(group, table, frame):
            return
        self.lay_things(table, frame)
        chair = self.draw("stool" if group == "bar table" else self.recipe.seats)
        half, deep = table.size[0] / 2, table.size[1]
        for x, y, turn in (
            (half / 2, deep, 0.0), (-half / 2, 0.0, np.pi), (-half / 2, deep, 0.0),
            (half / 2, 0.0, np.pi), (half, deep / 2, -np.pi / 2), (-half, deep / 2, np.pi / 2),
        )[: rng.integers(1, 7)]:  # fmt: skip
            away = chair.size[1] + rng.uniform(0.03, 0.3)
            seat = frame.moved(x, y, 0, turn).moved(rng.uniform(-0.1, 0.1), away, 0)
            self.place("chair", chair, seat.moved(0, 0, 0, np.pi + rng.uniform(-0.3, 0.3)))

    def hang(self, wall: int) -> None:
        """Pictures, clocks, lamps and a screen on a wall."""
        rng, palette, builder = self.rng, self.palette, self.builder
        for _ in range(rng.integers(1, 5)):
            along = rng.uniform(0.4, self.length(wall) - 0.4)
            frame = self.at_wall(wall, along).moved(0, 0, rng.uniform(1.2, 1.8))
            kind = str(
                rng.choice(["picture", "picture", "dial", "wall clock", "wall lamp", "flat tv"])
            )
            if kind == "picture":
                w, h = rng.uniform(0.25, 1.1), rng.uniform(0.25, 0.9)
                canvas = palette.add("painting", *palette.two_tones(0.4), rng.uniform(0.15, 0.3))
                if self.occupy(frame.moved(0, 0, -h / 2), (w, 0.06, h)):
                    put.picture(builder, frame, palette.wood, canvas, w, h)
            elif kind == "dial":
                if self.occupy(frame.moved(0, 0, -0.2), (0.4, 0.06, 0.4)):
                    put.clock(builder, frame, palette.metal, palette.matt_white, palette.dark)
            else:
                self.place(kind, self.draw(kind), frame)

    def place_door(self, wall: int) -> None:
        """A door, with the floor before it free."""
        door = self.draw("door")
        half, length = door.size[0] / 2, self.length(wall)
        frame = self.at_wall(wall, self.rng.uniform(half + 0.1, length - half - 0.1))
        if self.occupy(frame, (door.size[0], STEP_FREE, door.size[2])):
            self.add("door", door, frame)

    def place_window(self, wall: int) -> None:
        """A window with curtains or a blind."""
        rng, window, b = self.rng, self.draw("window"), self.builder
        half, low, length = window.size[0] / 2, window.elevation, self.length(wall)
        high = low + window.size[2]
        if 2 * half > length - 0.6 or high > self.size[2] - 0.05:
            return
        frame = self.at_wall(wall, rng.uniform(half + 0.3, length - half - 0.3))
        if not self.place("window", window, frame.moved(0, 0, low)):
            return
        if rng.random() < 0.4:
            for side in (-1, 1):
                curtain = self.draw("curtain")
                beside = frame.moved(side * (half + curtain.size[0] / 2), 0.0, curtain.elevation)
                self.place("curtain", curtain, beside)
        elif rng.random() < 0.5:
            near, far = window.size[1] + 0.01, window.size[1] + 0.035
            for z in np.arange(high - rng.uniform(0.2, 0.9) * window.size[2], high, 0.05):
                slat = (-half, near, z), (half, far, z + 0.03)
                b.box("blinds", self.palette.slat, frame, *slat)


def box_of(frame: Frame, size: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corners [3] of the upright box about a piece at the frame."""
    w, d, h = size
    corners = np.array([[x, y, 0] for x in (-w / 2, w / 2) for y in (0, d)]) @ frame.rotation.T
    corners += np.asarray(frame.origin)
    return corners.min(0), corners.max(0) + np.array([0, 0, h])
