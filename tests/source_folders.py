"""Tiny sources on disk, written the way their own tools write them."""

import json

import numpy as np
from PIL import Image

from chebsplat.stages.settings import IngestSection

SETTINGS = IngestSection(max_side=160, min_views=2)
SMALL = IngestSection(max_side=160, max_views=6, min_views=2)
ROW = "1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1\n"  # camera-to-world, moved along x


def image(path, size=(8, 6), value=100, mode="RGB"):
    """One colour; returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, size, value if mode in ("L", "I;16", "P") else (value,) * len(mode)).save(path)
    return path


def save(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(data)).save(path)


def write_transforms(folder, n=3, **changes):
    """Frames 9, 10, ... of grey 0, 20, ..., `changes` to the document."""
    frames = []
    for k in range(n):
        image(folder / f"images/frame_{k + 9}.png", value=20 * k)
        matrix = np.eye(4)
        matrix[0, 3] = k
        frames.append({"file_path": f"images/frame_{k + 9}", "transform_matrix": matrix.tolist()})
    document = {"w": 8, "h": 6, "fl_x": 10.0, "cx": 4, "cy": 3, "frames": frames} | changes
    (folder / "transforms.json").write_text(json.dumps({k: v for k, v in document.items() if v != "absent"}))
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


def write_nice_slam(folder, n=3, **changes):
    for k in range(n):
        image(folder / f"results/frame{k:06d}.jpg")
        image(folder / f"results/depth{k:06d}.png", mode="I;16", value=13107)
    (folder / "traj.txt").write_text("".join(ROW.format(k) for k in range(n)))
    camera = {"w": 8, "h": 6, "fx": 10, "fy": 10, "cx": 3.5, "cy": 2.5, "scale": 6553.5} | changes
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def write_semantic_nerf(folder, n=11):
    sequence = folder / "Sequence_1"
    for k in range(n):
        image(sequence / f"rgb/rgb_{k}.png", value=k)
        image(sequence / f"depth/depth_{k}.png", mode="I;16", value=1000 + k)
        image(sequence / f"semantic_class/semantic_class_{k}.png", mode="L", value=k % 3)
    (sequence / "traj_w_c.txt").write_text("".join(ROW.format(k) for k in range(n)))
    classes = [{"id": 0, "name": "undefined"}, {"id": 1, "name": "wall"}, {"id": 2, "name": "floor"}]
    (folder / "info_semantic.json").write_text(json.dumps({"classes": classes}))
    return folder
