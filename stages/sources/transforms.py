"""The transforms.json source of nerfstudio and instant-ngp: camera-to-world in OpenGL axes."""

from __future__ import annotations

import math
import os
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.images import header, is_image
from chebsplat.formats.names import few
from chebsplat.formats.points import read_cloud
from chebsplat.stages.sources import assembly, cameras, common, labels
from chebsplat.stages.sources.cameras import Camera
from chebsplat.stages.sources.colmap import LEAST
from chebsplat.stages.sources.common import Frame, Listing
from chebsplat.stages.sources.texts import number, read_json, shortened

NAMES = ("transforms.json", "transforms_train.json", "transforms_test.json", "transforms_val.json")
PARTS = ("file_path", "depth_file_path", "mask_path")
SPLITS = ("train_filenames", "test_filenames", "val_filenames")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # as COLMAP's FULL_OPENCV orders them
NERFSTUDIO = ("k1", "k2", "k3", "k4", "p1", "p2")  # of distortion_params
# subsets of FULL_OPENCV, and of OPENCV_FISHEYE
PERSPECTIVE = (
    "OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "PERSPECTIVE",
    "FULL_OPENCV",
)
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
READ = {
    *PARTS, *SPLITS, *DISTORTION, "distortion_params", "transform_matrix", "camera_model",
    "is_fisheye", "fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y",
    "ply_file_path",
}  # fmt: skip
# of other programs' own use: a box to render in, how sharp a photo is, where poses came from
OTHERS = {
    "aabb_scale", "scale", "offset", "sharpness", "colmap_im_id", "applied_transform",
    "applied_scale", "rotation", "n_extra_learnable_dims",
}  # fmt: skip
OPENGL = np.array([1.0, -1.0, -1.0, 1.0])  # y up, z backward -> y down, z forward


class Entry(NamedTuple):
    """A frame: the document that lists it, and its values, with those that all frames share."""

    origin: Path
    values: dict[str, Any]


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture; its labels are those of maps beside the document (`labels.give`).

    Choices: the points of `ply_file_path` are used unless there is depth, which gives more. Test
      views are those of nerfstudio's lists (test and validation), or of transforms_test.json, else
      of transforms_val.json.
    """
    entries = _entries(folder)
    listing = _listing(folder, entries)
    tests, origin = _split(folder, entries, listing)
    fields = assembly.assemble(listing, settings, class_names)
    cloud = _cloud(folder, entries[0])
    if cloud is not None and "depth" not in fields:
        points, colors = read_cloud(cloud)
        if len(points) < LEAST:
            fields["source"]["notes"].append(
                f"{cloud.name} holds {len(points)} points, too few: it is not used."
            )
        else:
            solid = ~assembly.in_empty_space(points, fields, listing)
            fields |= {
                "points": points[solid],
                "point_colors": None if colors is None else colors[solid],
            }
    if tests is not None:
        assembly.give_split(fields, tests, origin)
    return fields


def probe(folder: Path) -> dict[str, bool]:
    """Reads the JSON, and looks for files only if it lists depth."""
    entries = _entries(folder)
    depth = any(entry.values.get("depth_file_path") for entry in entries)
    if depth:
        present, _ = _present(folder, entries)
        depth = bool(present) and all(entry.values.get("depth_file_path") for entry, _ in present)
    return {"poses": True, "depth": depth, "labels": labels.place_in(folder) is not None}


def files(folder: Path) -> list[Path]:
    """The JSON, points, label maps and names, and images, depth and masks of frames on disk."""
    entries = _entries(folder)
    present, _ = _present(folder, entries)
    beside = [
        path for entry, _ in present for part in PARTS[1:] if (path := _part(folder, entry, part))
    ]
    beside += [sure for path in beside if (sure := common.sureness(path))]
    cloud = _cloud(folder, entries[0])
    beside += [
        *labels.files(folder),
        *(folder / name for name in labels.DOCUMENTS if common.present(folder / name)),
    ]
    return sorted(
        [
            *_documents(folder),
            *(Path(image) for _, image in present),
            *beside,
            *([cloud] if cloud else []),
        ]
    )


def _documents(folder: Path) -> list[Path]:
    """transforms.json; otherwise those of training views and of test, or else validation, views."""
    one, *parts = [folder / name for name in NAMES]
    if common.present(one) or not (present := [path for path in parts if common.present(path)]):
        return [one]
    return present[:2]


def _document(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Values that all frames of a document share, and the list of frames."""
    shared = read_json(path)
    entries = shared.pop("frames", None)
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} lists no frames; write it again")
    for entry in entries:
        if not isinstance(entry, dict) or not all(
            isinstance(entry.get(part, ""), str) for part in PARTS
        ):
            raise InputError(f"{path}: a frame is no object with paths as text; write it again")
        if not entry.get("file_path") or "transform_matrix" not in entry:
            raise InputError(f"{path}: a frame lacks file_path or transform_matrix; write it again")
    return shared, entries


def _entries(folder: Path) -> list[Entry]:
    return [
        Entry(path, shared | entry)
        for path in _documents(folder)
        for shared, entries in (_document(path),)
        for entry in entries
    ]


def _present(folder: Path, entries: list[Entry]) -> tuple[list[tuple[Entry, str]], list[str]]:
    """(entry, image) of the frames that are on disk; the paths of those that are not.

    Raises: InputError if a path leads out of the folder and matches no photo in it.
    Choices: a photo that is not at its listed path, as of another machine, is matched with one of
      the others by name (`common.matched`).
    """
    paths = [_below(folder, entry.values["file_path"]) for entry in entries]
    images = {
        path: image
        for path in paths
        if not _leads_out(path) and (image := _on_disk(os.path.join(folder, path)))
    }
    if absent := [path for path in paths if path not in images]:
        used = {
            *images.values(),
            *(str(_part(folder, entry, part)) for entry in entries for part in PARTS[1:]),
        }
        others = [
            name
            for name in common.names_below(folder)
            if name.partition("/")[0] not in common.BESIDE
            and os.path.join(folder, name) not in used
        ]
        images |= {
            path: os.path.join(folder, name)
            for path, name in common.matched(absent, others).items()
        }
    present, absent = [], []
    for entry, path in zip(entries, paths, strict=True):
        image = images.get(path)
        inside = (
            os.path.relpath(image, folder)
            if image and _leads_out(path)
            else _inside(folder, entry, path)
        )
        if image is None:
            absent.append(inside)
        else:
            present.append((entry._replace(values=entry.values | {"file_path": inside}), image))
    return present, absent


def _on_disk(path: str) -> str | None:
    """The file itself, or with an image suffix that the listing omits."""
    paths = [path + end for end in ("", ".png", ".jpg", ".jpeg")]
    return next(
        (
            p
            for p in paths
            if os.path.isfile(p) or (is_image(os.path.basename(p)) and os.path.lexists(p))
        ),
        None,
    )


def _below(folder: Path, listed: str) -> str:
    """A listed path relative to the folder, which may lead out of it."""
    path = listed.replace("\\", "/")
    return os.path.normpath(
        os.path.relpath(path, os.path.abspath(folder)) if os.path.isabs(path) else path
    )


def _leads_out(path: str) -> bool:
    return path.split("/")[0] == ".." or bool(PureWindowsPath(path).drive)


def _inside(folder: Path, entry: Entry, listed: str) -> str:
    """A listed path relative to the folder. Raises InputError if it leads out of it."""
    path = _below(folder, listed)
    if _leads_out(path):
        raise InputError(
            f"{entry.origin}: {listed} lies elsewhere; write paths relative to the folder"
        )
    return next(common.printable(entry.origin, [path]))


def _part(folder: Path, entry: Entry, part: str) -> Path | None:
    """The file that an entry lists as one of PARTS."""
    return folder / _inside(folder, entry, entry.values[part]) if entry.values.get(part) else None


def _name(path: str) -> str:
    """A view's name by its path below the folder: relative to images/ if it lies there."""
    return common.stem(path.removeprefix("images/"))


def _cloud(folder: Path, first: Entry) -> Path | None:
    """The points that the document names, if they are there."""
    listed = first.values.get("ply_file_path")
    if not isinstance(listed, str) or not common.present(
        path := folder / _inside(folder, first, listed)
    ):
        return None
    return path


def _listing(folder: Path, entries: list[Entry]) -> Listing:
    present, absent = _present(folder, entries)
    names = [_name(entry.values["file_path"]) for entry, _ in present]
    matrices = []
    for (entry, _), name in zip(present, names, strict=True):
        path = entry.origin
        try:
            matrix = np.array(entry.values["transform_matrix"])
        except ValueError as error:  # ragged, or nested more deeply than arrays can be
            raise InputError(
                f"{path}: {name} has no usable transform_matrix ({error}); write it again"
            ) from None
        if matrix.dtype.kind not in "iuf":
            raise InputError(
                f"{path}: transform_matrix of {name} does not hold numbers; write it again"
            )
        if matrix.shape not in ((3, 4), (4, 4)):
            raise InputError(
                f"{path}: transform_matrix of {name} is {matrix.shape}, not (4, 4); write it again"
            )
        matrices.append(np.vstack([matrix, [0, 0, 0, 1]])[:4] * OPENGL)
    poses = cameras.cam_from_world(entries[0].origin, np.reshape(matrices, (-1, 4, 4)), names)
    frames = []
    for (entry, image), name, pose in zip(present, names, poses, strict=True):
        depth, mask = (_part(folder, entry, part) for part in PARTS[1:])
        camera = _camera(entry.values, Path(image), entry.origin)
        sure = None if depth is None else common.sureness(depth)
        frames.append(Frame(name, Path(image), camera, pose, depth, mask=mask, sureness=sure))
    notes = []
    if absent:
        total = len(absent) + len(present)
        notes.append(f"{len(absent)} of {total} listed frames are absent on disk ({few(absent)}).")
        used = {image for _, image in present}
        there = [
            name
            for name in common.names_below(folder)
            if name.partition("/")[0] not in common.BESIDE
        ]
        if others := [name for name in there if os.path.join(folder, name) not in used]:
            notes.append(f"Images that no frame lists: {few(others)}.")
    if elsewhere := sum(
        frame.name != _name(os.path.relpath(frame.image, folder)) for frame in frames
    ):
        notes.append(
            f"{elsewhere} photos have another path on disk than is listed, and are told "
            "by their names."
        )
    listing = Listing("transforms", frames, notes=notes + _unused(folder, entries, frames))
    labels.give(listing, folder)
    return listing


def _unused(folder: Path, entries: list[Entry], frames: list[Frame]) -> list[str]:
    """Notes on keys of the documents, and files beside them, that are not read."""
    notes, name = [], entries[0].origin.name
    if unknown := sorted(set().union(*(entry.values for entry in entries)) - READ - OTHERS):
        notes.append(f"Not read of {name}: {', '.join(map(shortened, unknown))}.")
    if "ply_file_path" in entries[0].values and _cloud(folder, entries[0]) is None:
        notes.append(f"ply_file_path of {name} is absent on disk.")
    if not any(frame.mask for frame in frames) and any(common.names_below(folder / "masks")):
        notes.append(f"masks/ is not used: {name} lists none (mask_path).")
    there = [path for part in NAMES if common.present(path := folder / part)]
    if others := [path.name for path in there if path not in _documents(folder)]:
        notes.append(f"Not read: {', '.join(others)}.")
    return notes


def _split(folder: Path, entries: list[Entry], listing: Listing) -> tuple[set[str] | None, str]:
    """Names of the test views and the key or file that lists them, None without one; drops frames
    of no list from the listing.
    """
    documents = _documents(folder)
    if len(documents) == 2:
        test_entries = [
            entry for entry, _ in _present(folder, entries)[0] if entry.origin == documents[1]
        ]
        return {_name(entry.values["file_path"]) for entry in test_entries}, documents[1].name
    lists: dict[str, set[str]] = {}
    for key in SPLITS:
        listed = entries[0].values.get(key)
        if listed is None:
            continue
        if not isinstance(listed, list) or not all(isinstance(path, str) for path in listed):
            raise InputError(f"{documents[0]}: {key} is no list of paths; write it again")
        lists[key] = {_name(_inside(folder, entries[0], path)) for path in listed}
    if not lists:
        return None, ""
    train, *tests = (lists.get(key, set()) for key in SPLITS)
    names = {frame.name for frame in listing.frames}
    if not any(tests):
        return names - train, "train_filenames"
    if train and (outside := names - train.union(*tests)):
        listing.frames = [frame for frame in listing.frames if frame.name not in outside]
        listing.notes.append(
            f"{len(outside)} frames are in no list of {documents[0].name} and are left out."
        )
    return set().union(*tests), " and ".join(key for key in SPLITS[1:] if key in lists)


def _camera(values: dict[str, Any], image: Path, path: Path) -> Camera:
    """The camera of one frame. Raises InputError on an unsupported lens, or no focal length."""
    named = values.get("camera_model")
    model = (
        "OPENCV_FISHEYE"
        if values.get("is_fisheye")
        else "OPENCV"
        if named is None
        else shortened(named).strip("'")
    )
    if model not in PERSPECTIVE + FISHEYE:
        raise InputError(
            f"{path}: camera_model {model} is not supported ({', '.join(PERSPECTIVE + FISHEYE)} "
            "are); undistort the photos first, for example with `colmap image_undistorter`"
        )
    size = (values["w"], values["h"]) if "w" in values and "h" in values else header(image)[0]
    try:
        width, height = (number(v) for v in size)
        fx = _focal(values, "x", width)
        fy = _focal(values, "y", height) or fx
        centre = [number(values.get("cx", width / 2)), number(values.get("cy", height / 2))]
        k = {key: number(values.get(key) or 0.0) for key in DISTORTION}
        if "distortion_params" in values:
            k |= dict(zip(NERFSTUDIO, map(number, values["distortion_params"]), strict=True))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: intrinsics are no numbers that can be used ({error}); write it again"
        ) from None
    if fx is None or fy is None:
        raise InputError(f"{path} has neither fl_x nor camera_angle_x; write it again")
    nonzero = {key for key, value in k.items() if value}
    kind = "FULL_OPENCV"
    used: tuple[str, ...] = DISTORTION
    if model in FISHEYE:
        kind, used = "OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")
    # whose k4 is OpenCV's; nerfstudio means another, which it does not undo either
    elif model != "FULL_OPENCV":
        used = DISTORTION[:5]
        kind = "FULL_OPENCV" if "k3" in nonzero else "OPENCV" if nonzero else "PINHOLE"
    if beyond := sorted(nonzero - set(used)):
        raise InputError(
            f"{path}: {beyond[0]} of a camera {model} is not supported; write FULL_OPENCV if it is "
            "OpenCV's, or undistort the photos first"
        )
    lens = [k[key] for key in (used if model in FISHEYE else DISTORTION)]
    return cameras.camera_of(
        path, kind, (fx, fy, *centre, *lens)[: cameras.MODELS[kind]], width, height
    )


def _focal(values: dict[str, Any], axis: str, pixels: float) -> float | None:
    """Focal length of an axis in pixels, from fl_* or from the whole angle of view."""
    if f"fl_{axis}" in values:
        return number(values[f"fl_{axis}"])
    if f"camera_angle_{axis}" in values:
        angle = number(values[f"camera_angle_{axis}"])
        if not 0 < angle < math.pi:
            raise ValueError(f"camera_angle_{axis} is {angle:g}, not between 0 and pi")
        return 0.5 * pixels / math.tan(0.5 * angle)
    return None
