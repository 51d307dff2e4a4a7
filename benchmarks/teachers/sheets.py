"""Contact sheets of modelled furniture, to be looked at: pieces by group, and rooms beside their
labels; two JPEG pictures. Nothing is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw

from benchmarks import shared
from chebsplat.stages.sources.generated import photograph
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.catalogue import FOLDER, Piece, read_mesh
from chebsplat.synthetic.furnished import PIECES, Catalogue, furnished
from chebsplat.synthetic.layout import MODELLED, Palette, Room
from chebsplat.synthetic.mesh import Builder, Frame
from chebsplat.synthetic.rays import RayCaster, intrinsics, look_at, walk

SIDE = 96  # pixels of a piece's picture
ROOM = (240, 180)  # pixels of a room's
COLUMNS = 6  # of rooms, each a photo above its labels
CAPTION = 14  # pixels
FLOOR = 3.0  # piece sizes


def portrait(piece: Piece) -> np.ndarray:
    """A piece on a floor of one colour, from the front, its left and above: u8 [SIDE, SIDE, 3]."""
    builder, palette = Builder(), Palette(np.random.default_rng(0))
    mesh, here = read_mesh(piece), Frame((0.0, 0.0, 0.0))
    middle, size = mesh.vertices.mean(0).astype(float), max(piece.size)
    for color, triangles in mesh.parts:
        tone = np.clip(color, 0.03, 0.85)
        builder.add(None, palette.add("plain", tone, tone, 0.1), here, mesh.vertices, triangles)
    around = FLOOR * size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    floor = np.concatenate([middle[:2] + around, np.full((4, 1), -0.002)], 1)
    white = np.full(3, 0.7)
    builder.add(
        None, palette.add("plain", white, white, 0.0), here, floor, np.array([[0, 1, 2], [0, 2, 3]])
    )
    above = np.array([middle[0], middle[1] + size, 2.5 * size])
    lights = np.array([[above, (size, size, 0)]])
    room = Room(builder.soup(), palette.table, lights, (1.0, 1.0, 1.0))
    target = np.array([middle[0], middle[1], piece.size[2] / 2])
    pose = look_at(target + size * np.array([-0.8, 2.0, 0.9]), target)
    return taken(room, pose, (SIDE, SIDE), 40)[0]


def taken(
    room: Room, pose: np.ndarray, size: tuple[int, int], fov: float
) -> tuple[np.ndarray, np.ndarray]:
    """A photo u8 [H, W, 3] of a room, and labels i16 [H, W]; fov: in degrees, across."""
    caster = RayCaster(room.soup.vertices, room.soup.triangles)
    image, _, labels = photograph(room, caster, intrinsics(*size, fov), pose, *size)
    return image, labels


def sheet_of_pieces(catalogue: Catalogue, columns: int = 10) -> Image.Image:
    """A row of portraits for each group, with its name and class: as many as fit, evenly chosen."""
    height = SIDE + CAPTION
    sheet = Image.new("RGB", (columns * SIDE, len(catalogue.groups) * height), "white")
    draw = ImageDraw.Draw(sheet)
    for row, (group, pieces) in enumerate(catalogue.groups.items()):
        label = PIECES[group].get("class", "no class")
        draw.text((3, row * height + 1), f"{group} ({len(pieces)}): {label}", fill="black")
        chosen = np.linspace(0, len(pieces) - 1, min(columns, len(pieces))).round().astype(int)
        for column, k in enumerate(chosen):
            picture = Image.fromarray(portrait(pieces[k]))
            sheet.paste(picture, (column * SIDE, row * height + CAPTION))
    return sheet


def sheet_of_rooms(catalogue: Catalogue, seeds: Sequence[int]) -> Image.Image:
    """A photo of each room above its labels, and a legend of the classes; no label: black."""
    width, height = ROOM
    colors = (255 * colormaps["tab20"](np.arange(len(CLASS_NAMES)))[:, :3]).astype(np.uint8)
    rows = -(-len(seeds) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * width, rows * 2 * height + 2 * CAPTION), "white")
    for k, seed in enumerate(seeds):
        room = furnished(seed, catalogue)
        image, labels = taken(room, walk(room.size, 80, seed)[20], ROOM, 72)
        painted = np.where(labels[..., None] >= 0, colors[labels], 0).astype(np.uint8)
        left, top = k % COLUMNS * width, k // COLUMNS * 2 * height
        sheet.paste(Image.fromarray(image), (left, top))
        sheet.paste(Image.fromarray(painted), (left, top + height))
    draw, each = ImageDraw.Draw(sheet), COLUMNS * width // (len(CLASS_NAMES) // 2 + 1)
    for k, name in enumerate(CLASS_NAMES):
        row, column = divmod(k, len(CLASS_NAMES) // 2 + 1)
        left, top = column * each, rows * 2 * height + row * CAPTION
        draw.rectangle((left, top + 2, left + 10, top + 12), fill=tuple(colors[k].tolist()))
        draw.text((left + 14, top + 1), name, fill="black")
    return sheet


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("sheets", __doc__)
    parser.add_argument("--furniture", type=Path, default=FOLDER, help="folder of libraries")
    parser.add_argument("--rooms", type=int, default=24)
    options = parser.parse_args(arguments)
    catalogue = Catalogue(options.furniture)
    options.out.mkdir(parents=True, exist_ok=True)
    for name, sheet in (
        ("furniture", sheet_of_pieces(catalogue)),
        ("rooms", sheet_of_rooms(catalogue, MODELLED[: options.rooms])),
    ):
        path = options.out / f"{name}.jpg"
        sheet.save(path, quality=60)
        print(path)
