"""Writers that lay a capture out on disk as data sets do: PNG where the format allows it, so that
nothing is lost.
"""

import json

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation
from source_folders import save

from chebsplat.evaluation.protocols import scannet_closed, scannet_open


def matrix_text(matrix):
    return "\n".join(" ".join(repr(float(v)) for v in row) for row in matrix) + "\n"


def write_text(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def world_from_cam(fields):
    return np.linalg.inv(fields["cam_from_world"])


def stored_depth(depth, scale=1000.0):
    return np.round(np.nan_to_num(depth) * scale).astype(np.uint16)


def raw_labels(labels, ids):
    """Raw ids of class indices; -1 is 0."""
    return np.array([*ids, 0], np.uint16)[labels]


def write_nice_slam(folder, fields, suffix="png"):
    for k, image in enumerate(fields["images"]):
        save(folder / f"results/frame{k:06d}.{suffix}", image)
        save(folder / f"results/depth{k:06d}.png", stored_depth(fields["depth"][k], 6553.5))
    rows = (" ".join(repr(float(v)) for v in pose.ravel()) for pose in world_from_cam(fields))
    write_text(folder / "traj.txt", "\n".join(rows) + "\n")
    K, (height, width) = fields["Ks"][0], fields["images"].shape[1:3]
    camera = {
        "w": width,
        "h": height,
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2] - 0.5,
        "cy": K[1, 2] - 0.5,
    }
    write_text(folder / "cam_params.json", json.dumps({"camera": camera | {"scale": 6553.5}}))


def write_semantic_nerf(folder, fields):
    ids = list(range(1, len(fields["class_names"]) + 1))
    sequence = folder / "Sequence_1"
    for k, image in enumerate(fields["images"]):
        save(sequence / f"rgb/rgb_{k}.png", image)
        save(sequence / f"depth/depth_{k}.png", stored_depth(fields["depth"][k]))
        labels = raw_labels(fields["labels"][k], ids).astype(np.uint8)
        save(sequence / f"semantic_class/semantic_class_{k}.png", labels)
    rows = (" ".join(repr(float(v)) for v in pose.ravel()) for pose in world_from_cam(fields))
    write_text(sequence / "traj_w_c.txt", "\n".join(rows) + "\n")
    classes = [{"id": k, "name": name} for k, name in zip(ids, fields["class_names"], strict=True)]
    write_text(
        folder / "info_semantic.json",
        json.dumps({"classes": [{"id": 0, "name": "undefined"}, *classes]}),
    )


def write_colmap(folder, fields):
    """With scene.json for the names of labels, as images/ and a text model."""
    ids = list(range(1, len(fields["class_names"]) + 1))
    K, (height, width) = fields["Ks"][0], fields["images"].shape[1:3]
    values = " ".join(repr(float(v)) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    write_text(folder / "sparse/0/cameras.txt", f"1 PINHOLE {width} {height} {values}\n")
    rows = []
    for k, (name, pose) in enumerate(
        zip(fields["names"], fields["cam_from_world"], strict=True), 1
    ):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        rows.append(
            f"{k} {' '.join(repr(float(v)) for v in (*quaternion, *pose[:3, 3]))} 1 {name}.png\n\n"
        )
        save(folder / f"images/{name}.png", fields["images"][k - 1])
        save(folder / f"depth/{name}.png", stored_depth(fields["depth"][k - 1]))
        save(
            folder / f"semantic/{name}.png",
            raw_labels(fields["labels"][k - 1], ids).astype(np.uint8),
        )
    write_text(folder / "sparse/0/images.txt", "".join(rows))
    write_text(folder / "sparse/0/points3D.txt", "")
    write_text(
        folder / "labels.json",
        json.dumps(dict(zip(map(str, ids), fields["class_names"], strict=True))),
    )


def write_seven_scenes(folder, fields, suffix="png", unknown=65_535):
    for k, pose in enumerate(world_from_cam(fields)):
        save(folder / f"frame-{k:06d}.color.{suffix}", fields["images"][k])
        depth = stored_depth(fields["depth"][k])
        save(folder / f"frame-{k:06d}.depth.png", np.where(depth == 0, np.uint16(unknown), depth))
        write_text(folder / f"frame-{k:06d}.pose.txt", matrix_text(pose))
    write_text(folder / "camera-intrinsics.txt", matrix_text(fields["Ks"][0]))


# ScanNet's raw ids of the 20 shared classes, the same in both of its tables; 22 is books, which
# both call other props.
SCANNET_IDS = {"wall": 1, "floor": 3, "cabinet": 7, "bed": 11, "chair": 2, "sofa": 6, "table": 4,
               "door": 5,
               "window": 16, "shelves": 8, "counter": 35, "curtain": 21, "ceiling": 41,
               "refrigerator": 27,
               "television": 33, "person": 80, "toilet": 17, "sink": 14, "lamp": 28, "bag": 47,
               "otherprop": 22}  # fmt: skip
COCO_IDS = {"wall": 1, "floor": 2, "cabinet": 3, "bed": 4, "chair": 5, "sofa": 6, "table": 7,
            "door": 8, "window": 9,
            "shelves": 10, "counter": 11, "curtain": 12, "ceiling": 13, "refrigerator": 14,
            "television": 15,
            "person": 16, "toilet": 17, "sink": 18, "lamp": 19, "bag": 20,
            "otherprop": 0}  # fmt: skip
NYU_IDS = {"wall": 1, "floor": 2, "cabinet": 3, "bed": 4, "chair": 5, "sofa": 6, "table": 7,
           "door": 8, "window": 9,
           "shelves": 15, "counter": 12, "curtain": 16, "ceiling": 22, "refrigerator": 24,
           "television": 25,
           "person": 31, "toilet": 33, "sink": 34, "lamp": 35, "bag": 37,
           "otherprop": 23}  # fmt: skip
REDUCED_IDS = COCO_IDS | {"counter": 10, "shelves": 11, "otherprop": 21}


def write_table(path, column, values):
    rows = [f"{raw}\t{name}\t{values[name]}" for name, raw in SCANNET_IDS.items()]
    write_text(path, "\n".join([f"id\traw_category\t{column}", *rows]) + "\n")


def write_scannet(folder, fields, suffix="png"):
    """What both layouts share; frame k is called 10 k, as frames that are left out leave gaps."""
    for k, pose in enumerate(world_from_cam(fields)):
        save(folder / f"color/{10 * k}.{suffix}", fields["images"][k])
        write_text(folder / f"pose/{10 * k}.txt", matrix_text(pose))
    K = np.eye(4)
    K[:3, :3] = fields["Ks"][0]
    K[:2, 2] -= 0.5
    write_text(folder / "intrinsic/intrinsic_color.txt", matrix_text(K))


def write_scannet_sg(folder, fields, suffix="png"):
    write_scannet(folder, fields, suffix)
    ids = [SCANNET_IDS[name] for name in scannet_open.CLASSES]
    for k, labels in enumerate(fields["labels"]):
        save(folder / f"label-filt/{10 * k}.png", raw_labels(labels, ids))
    write_table(folder / "scannetv2-labels.modified.tsv", "cocomapid", COCO_IDS)
    kinds = [(axis, "f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    points = zip(fields["points"], fields["point_colors"], strict=True)
    rows = np.array([(*xyz, *rgb) for xyz, rgb in points], kinds)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "points3d.ply"))


def write_scannet_pl(folder, fields, folded=True, objects=None):
    """`folded`: labels as the authors give them away, reduced; otherwise ScanNet's own and its
    objects' ids.

    Pseudo labels of half the size where the fields have them, with the confidence of each pixel.
    """
    write_scannet(folder, fields)
    own, reduced = ([ids[n] for n in scannet_closed.CLASSES] for ids in (SCANNET_IDS, REDUCED_IDS))
    for k, labels in enumerate(fields.get("pseudo_labels", ())):
        save(folder / f"m2f_semantics/{10 * k}.png", raw_labels(labels[::2, ::2], reduced))
        place = folder / f"m2f_probabilities/{10 * k}.npz"
        place.parent.mkdir(exist_ok=True)
        confidence = fields["confidence"][k, ::2, ::2].astype(np.float32)
        shares = np.zeros((*confidence.shape, 22), np.float32)
        np.savez_compressed(
            place, probability=shares, confidence=confidence, confidence_notta=confidence
        )
    for k, labels in enumerate(fields["labels"]):
        save(folder / f"depth/{10 * k}.png", stored_depth(fields["depth"][k]))
        if folded:
            save(
                folder / f"rs_semantics/{10 * k}.png", raw_labels(labels, reduced).astype(np.uint8)
            )
        else:
            save(folder / f"semantics/{10 * k}.png", raw_labels(labels, own))
            save(folder / f"instance/{10 * k}.png", objects[k].astype(np.uint8))
    if not folded:
        write_table(folder.parent / "scannet-labels.combined.tsv", "nyu40id", NYU_IDS)
    names = [str(10 * k) for k in range(len(fields["images"]))]
    split = {"train": [name for k, name in enumerate(names) if k % 5], "test": names[::5]}
    write_text(folder / "splits.json", json.dumps(split))
    # must never be unpickled
    (folder / "segmentation_data.pkl").write_bytes(b"cos\nsystem\n(S'exit 1'\ntR.")
