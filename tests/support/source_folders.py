"""Tiny sources on disk, written the way their own tools write them."""

import json

import numpy as np
from PIL import Image

from chebsplat.formats.photo_model import PhotoModel
from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import photos

SETTINGS = IngestSection(max_side=160, min_views=2)
SMALL = IngestSection(max_side=160, max_views=6, min_views=2)


def image(path, size=(8, 6), value=100, mode="RGB"):
    """One colour; returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, size, value if mode in ("L", "I;16", "P") else (value,) * len(mode)).save(path)
    return path


def alone(folder, settings=SETTINGS):
    """Fields of photos that come alone, as of a model that looks along z from places a metre
    apart.
    """
    found, notes = photos._listed(folder)
    model = model_of(
        [shot.name for shot in found], [shot.size for shot in found], [shot.focal for shot in found]
    )
    model.notes = notes
    return photos.read(folder, settings, model)


def model_of(names, sizes, focals):
    """A model without points; focals: 35 mm equivalents, None: 1.2 longer sides."""
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, 0, 3] = -np.arange(len(names))
    longs = [
        max(size) * (1.2 if focal is None else focal / 36)
        for size, focal in zip(sizes, focals, strict=True)
    ]
    cameras = [
        ["SIMPLE_PINHOLE", [long, w / 2, h / 2], w, h]
        for long, (w, h) in zip(longs, sizes, strict=True)
    ]
    none = np.zeros((0, 3))
    return PhotoModel(
        names,
        cameras,
        np.arange(len(names)),
        poses,
        none,
        none,
        none[:, 0],
        none[:, :2].astype(int),
    )


def save(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(data)).save(path)


def tiny(n=3, size=(8, 6)):
    """Fields of n views of one grey, depth and label each, moved along x by 1 m a view: what
    `layouts` writes.
    """
    width, height = size
    number = np.broadcast_to(np.arange(n)[:, None, None], (n, height, width))
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = -np.arange(n)
    return {"images": np.repeat(number[..., None], 3, 3).astype(np.uint8),
            "depth": 1 + number / 1000,
            "labels": (number % 3 - 1).astype(np.int16), "class_names": ["wall", "floor"],
            "Ks": np.tile([[10, 0, width / 2], [0, 10, height / 2], [0, 0, 1]], (n, 1, 1)),
            "cam_from_world": poses,
            "points": np.eye(3, dtype=np.float32),
            "point_colors": np.zeros((3, 3), np.uint8)}  # fmt: skip


def write_transforms(folder, n=3, **changes):
    """Frames 9, 10, ... of grey 0, 20, ..., `changes` to the document."""
    frames = []
    for k in range(n):
        image(folder / f"images/frame_{k + 9}.png", value=20 * k)
        matrix = np.eye(4)
        matrix[0, 3] = k
        frames.append({"file_path": f"images/frame_{k + 9}", "transform_matrix": matrix.tolist()})
    document = {"w": 8, "h": 6, "fl_x": 10.0, "cx": 4, "cy": 3, "frames": frames} | changes
    (folder / "transforms.json").write_text(
        json.dumps({k: v for k, v in document.items() if v != "absent"})
    )
    return folder


def change_frame(folder, k=0, **changes):
    document = json.loads((folder / "transforms.json").read_text())
    document["frames"][k] |= changes
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def write_colmap(folder, model="PINHOLE 8 6 10 10 4 3", names=("a.png", "b.png", "c.png")):
    """A text model, depth 1.5 m, label 7 everywhere."""
    size = tuple(int(v) for v in model.split()[1:3])
    (folder / "sparse/0").mkdir(parents=True)
    (folder / "sparse/0/cameras.txt").write_text(f"1 {model}\n")
    rows = [f"{k + 1} 1 0 0 0 {k} 0 0 1 {name}\n\n" for k, name in enumerate(names)]
    (folder / "sparse/0/images.txt").write_text("".join(rows))
    (folder / "sparse/0/points3D.txt").write_text("")
    for name in names:
        image(folder / "images" / name, size)
        image(folder / "depth" / name, size, mode="I;16", value=1500)
        image(folder / "semantic" / name, size, mode="L", value=7)
    (folder / "labels.json").write_text(json.dumps({"7": "sofa", "8": "void", "9": "lamp"}))
    return folder
