"""Assembly of a capture from frames: images and their maps as pinhole views of one size."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageStat
from scipy.fft import dctn, idctn
from scipy.ndimage import map_coordinates

from chebsplat.cameras import unproject
from chebsplat.errors import DataFailure
from chebsplat.formats.images import header
from chebsplat.labels.agreement import project
from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import labels
from chebsplat.stages.sources.cameras import (
    DISTORTED,
    EQUIRECTANGULAR,
    FACES,
    Camera,
    scaled,
    undistorted,
)
from chebsplat.stages.sources.common import OWN_SIDE, Frame, Listing, distinct, natural
from chebsplat.stages.sources.pictures import (
    DEEP,
    GREY,
    companion,
    confidences,
    nearest,
    open_photo,
)

WORKERS = 4
MOST_EMPTY = 1 / 3  # of the views that see a point
MOST_CUT = 0.03  # of a side of views of photos alone, to make them as large as others
COMPARED = 8  # views whose variance is compared with their photos'
DOUBLED_ABOVE = 2 / 3  # pixels of a view per pixel of its photo, for splines to keep its detail


def assemble(
    listing: Listing, settings: IngestSection, class_names: tuple[str, ...] | None = None
) -> dict[str, Any]:
    """Read all frames into the fields of a capture.

    Choices: `max_views` picks evenly from the naturally sorted frames. Images are reduced to
      `max_side` by averaging, and undistorted in the same step where a lens bends them
      (`resampled`); depth, labels and masks take the nearest pixel of the file. Of photos alone,
      whose lenses were found, views of almost one size are cut to one; other smaller views are
      padded at the right and the bottom, where the loss mask is false, as in a photo that is all
      transparent. Depth is used only if every frame of the source has it; pixels of a frame without
      labels have none.
    Raises:  InputError naming a bad file, DataFailure under `min_views` or where no label has a
      name.
    """
    frames, notes = choose_frames(listing, settings)
    most_cut = MOST_CUT if listing.kind == "photos" else 0.0
    shapes = geometries([frame.camera for frame in frames], settings.max_side, most_cut)
    full = (
        len(frames),
        max(shape.height for shape in shapes),
        max(shape.width for shape in shapes),
    )
    stacks = empty_stacks(listing, frames, full, notes)
    lookup = functools.lru_cache(8)(positions)  # frames of one camera share it
    compared = np.linspace(0, len(frames) - 1, min(COMPARED, len(frames))).astype(int)

    def fill(k: int) -> None:
        view = read_view(
            frames[k], listing, shapes[k], lookup(frames[k].camera, shapes[k]), set(stacks)
        )
        if not view["opaque"].all():
            listing.empty[frames[k].name] = ~view["opaque"]
        for name in stacks.keys() & view.keys():
            stacks[name][k, : shapes[k].height, : shapes[k].width] = view[name]

    def share_kept(k: int) -> float:
        camera = frames[k].camera
        pixels = stacks["images"][k, : shapes[k].height, : shapes[k].width]
        with open_photo(frames[k].image, (camera.width, camera.height), listing.upright) as (
            image,
            _,
        ):
            return variance_kept(image, pixels, lookup(camera, shapes[k]))

    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(fill, range(len(frames))))
        shares = list(pool.map(share_kept, compared))
    if not stacks["loss_mask"].any():
        raise DataFailure(
            f"{frames[0].mask or frames[0].image}: no pixel of any view counts; correct the masks"
        )
    source: dict[str, Any] = {"kind": listing.kind, "notes": notes}
    fields: dict[str, Any] = {
        "source": source,
        "names": [frame.name for frame in frames],
        "images": stacks["images"],
    }
    fields["Ks"] = np.stack([shape.K for shape in shapes])
    poses = [frame.pose for frame in frames if frame.pose is not None]
    fields["cam_from_world"] = np.stack(poses) if listing.has("pose") else None
    if "depth" in stacks:
        fields["depth"] = stacks["depth"]
    if "labels" in stacks:
        kind, raw = labels.resolved(listing, stacks.pop("labels"))
        fields["labels"], fields["class_names"], remarks = labels.indexed(
            raw, listing.label_names, class_names or listing.class_names, kind
        )
        notes += remarks
        source["labels"] = labels.line(listing, kind, fields["labels"])
    if "pseudo_labels" in stacks:
        classes = fields.get("class_names") or class_names or listing.class_names
        fields["pseudo_labels"], fields["class_names"], remarks = labels.indexed(
            stacks["pseudo_labels"],
            listing.pseudo_names,
            classes and tuple(classes),
            what="Pseudo label",
        )
        fields["confidence"] = stacks["confidence"]
        notes += remarks
    if listing.empty:
        notes.append(
            f"{len(listing.empty)} of {len(frames)} photos have transparent pixels, which are "
            "empty space."
        )
    if not stacks["loss_mask"].all():
        fields["loss_mask"] = stacks["loss_mask"]
        notes.append(f"{1 - stacks['loss_mask'].mean():.1%} of the pixels are masked.")
    if (least := min(shape.factor for shape in shapes)) < 1:
        notes.append(f"Images are reduced by {least:.3f} (ingest.max_side).")
    if models := sorted({frame.camera.model for frame in frames} & set(DISTORTED)):
        notes.append(
            f"Images are undistorted ({', '.join(models)}), and figures are of these where they "
            "do not say."
        )
        source["undistorted"] = models
    fields["variance_kept"] = float(np.mean(shares))
    return fields | {"altered": lambda names: altered(frames, listing, names, settings.max_side)}


def altered(
    frames: list[Frame], listing: Listing, names: set[str], max_side: int
) -> Iterator[tuple[str, Camera, Any]]:
    """Name, camera and photo of those of the views `names` that are altered; none of faces."""
    for frame in frames:
        camera = frame.camera
        changed = camera.model in DISTORTED or max(camera.width, camera.height) > max_side
        if frame.name in names and changed and camera.model != EQUIRECTANGULAR:
            with open_photo(frame.image, (camera.width, camera.height), listing.upright) as (
                image,
                _,
            ):
                yield frame.name, camera, image


def as_taken(photos: Iterable[tuple[str, Camera, Any]]) -> dict[str, Any]:
    """Fields `taken` u8 [T, H, W, 3] and `lenses` of a capture: photos as they are, reduced to
    OWN_SIDE, each with its name and camera; smaller ones are padded at the right and the bottom.
    """
    small, lenses = [], []
    for name, camera, image in photos:
        factor = min(1.0, OWN_SIDE / max(image.size))
        width, height = (max(round(side * factor), 1) for side in image.size)
        small.append(np.asarray(image.resize((width, height), Image.Resampling.BOX)))
        lens = camera.colmap
        lens.rescale(width, height)
        lenses.append([name, camera.model, [float(value) for value in lens.params], width, height])
    if not small:
        return {}
    stack = np.zeros(np.max([(len(small), *photo.shape) for photo in small], 0), np.uint8)
    for place, photo in zip(stack, small, strict=True):
        place[: photo.shape[0], : photo.shape[1]] = photo
    return {"taken": stack, "lenses": lenses}


def empty_stacks(
    listing: Listing, frames: list[Frame], full: tuple[int, int, int], notes: list[str]
) -> dict[str, np.ndarray]:
    """Empty stacks of the maps of the views, by name; adds notes on maps that only some have."""
    stacks = {"images": np.zeros((*full, 3), np.uint8), "loss_mask": np.zeros(full, bool)}
    empties = {"depth": np.float32(np.nan), "labels": np.int32(-1), "pseudo_labels": np.int32(0)}
    for name, empty in (empties | {"confidence": np.float16(0)}).items():
        n = sum(getattr(frame, name) is not None for frame in listing.frames)
        of = len(listing.frames)
        if n == of or (name == "labels" and any(frame.labels for frame in frames)):
            stacks[name] = np.full(full, empty)
            if n < of:
                notes.append(f"{n} of {of} views have labels; the others count as unknown.")
        elif n:
            notes.append(
                f"Only {n} of {of} frames have {name.replace('_', ' ')}, which are left out."
            )
    return stacks


def in_empty_space(points: np.ndarray, fields: dict[str, Any], listing: Listing) -> np.ndarray:
    """Mask [N] of a source's points [N, 3] that lie in empty space; adds a note with their number.

    Choices: points at a transparent pixel in more than MOST_EMPTY of the views that they project
      into; a silhouette may be a pixel off. Without this they would stay, and turn black.
    """
    empty, visible_count = np.zeros(len(points)), np.zeros(len(points))
    if not listing.empty:
        return empty > visible_count
    for name, K, pose in zip(fields["names"], fields["Ks"], fields["cam_from_world"], strict=True):
        clear = listing.empty.get(name, np.zeros(fields["images"].shape[1:3], bool))
        local = points @ pose[:3, :3].T + pose[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            place = (local @ K.T)[:, :2] / local[:, 2:]
        here = np.flatnonzero(
            (local[:, 2] > 0) & ((place >= 0) & (place < clear.shape[::-1])).all(1)
        )
        column, row = place[here].astype(int).T
        visible_count[here] += 1
        empty[here] += clear[row, column]
    lost: np.ndarray = empty > MOST_EMPTY * visible_count
    if lost.any():
        fields["source"]["notes"].append(
            f"{lost.sum()} of {len(points)} points lie in empty space and are left out."
        )
    return lost


def give_split(fields: dict[str, Any], tests: set[str], origin: str) -> None:
    """Set `is_test` by name, or note that the views in use leave one side of the split empty."""
    is_test = np.array([name in tests for name in fields["names"]])
    if is_test.any() and not is_test.all():
        fields["is_test"] = is_test
        fields["source"]["notes"].append(f"{is_test.sum()} test views are those of {origin}.")
    else:
        fields["source"]["notes"].append(
            f"{origin}'s split leaves no test or no training view; it is not used."
        )


def choose_frames(listing: Listing, settings: IngestSection) -> tuple[list[Frame], list[str]]:
    """The frames to read, and the notes so far."""
    notes, n_listed = list(listing.notes), len(listing.frames)
    frames = [
        frame for frame in listing.frames if frame.pose is None or np.isfinite(frame.pose).all()
    ]
    if len(frames) < n_listed:
        lost = n_listed - len(frames)
        notes.append(
            f"{lost} of {n_listed} frames have a pose that is not finite and are left out."
        )
    if len(frames) < settings.min_views:
        raise DataFailure(
            f"{len(frames)} usable frames; ingest.min_views is {settings.min_views}. "
            f"{' '.join(notes)}"
        )
    frames = sorted(frames, key=lambda frame: natural(frame.name))
    distinct((frame.name, frame.image) for frame in frames)
    if settings.max_views is not None and len(frames) > settings.max_views:
        picked = np.linspace(0, len(frames) - 1, settings.max_views).round().astype(int)
        notes.append(f"{len(picked)} of {len(frames)} views are used (ingest.max_views).")
        frames = [frames[k] for k in picked]
    if not listing.upright:  # upright photos have cameras of their size
        before = frames
        frames = [
            replace(frame, camera=scaled(frame.camera, header(frame.image)[0])) for frame in frames
        ]
        changed = [new for new, old in zip(frames, before, strict=True) if new.camera != old.camera]
        if changed:
            notes.append(
                f"Cameras of {len(changed)} views are scaled to their photos, which have another "
                "size."
            )
    if n := sum(frame.camera.model == EQUIRECTANGULAR for frame in frames):
        frames = [face for frame in frames for face in faces(frame)]
        notes.append(
            f"{n} photos of all directions give {len(FACES)} views each, without what is near "
            "above and below."
        )
    return frames, notes


def face_names(name: str) -> list[str]:
    """Names of the faces of a photo of all directions."""
    return [f"{name}.{face}" for face in FACES]


def faces(frame: Frame) -> list[Frame]:
    """The views of a photo: itself, or of one of all directions its faces.

    Choices: a photo's left and right end, where it is cut, lie between two faces.
    """
    if frame.camera.model != EQUIRECTANGULAR:
        return [frame]
    views = []
    for name, turn in zip(face_names(frame.name), FACES.values(), strict=True):
        camera, pose = replace(frame.camera, turn=turn), frame.pose
        if pose is not None:
            pose = np.vstack([camera.turned.T @ pose[:3], pose[3:]])
        views.append(replace(frame, name=name, camera=camera, pose=pose))
    return views


@dataclass(frozen=True, eq=False)
class Geometry:
    """A photo's pinhole view: K [3, 3], size in its pixels; factor: its pixels per photo pixel;
    whole: (width, height) before it was cut at the right and the bottom.
    """

    K: np.ndarray
    width: int
    height: int
    factor: float
    whole: tuple[int, int]


def geometry(camera: Camera, max_side: int) -> Geometry:
    """The view's camera: undistorted, then reduced until no side exceeds `max_side`."""
    plain = undistorted(camera)
    (fx, fy, cx, cy), width, height = plain.pinhole, plain.width, plain.height
    factor = min(1.0, max_side / max(width, height))
    w, h = max(round(width * factor), 1), max(round(height * factor), 1)
    K = np.array(
        [[fx * w / width, 0, cx * w / width], [0, fy * h / height, cy * h / height], [0, 0, 1.0]]
    )
    return Geometry(K, w, h, factor, (w, h))


def geometries(cameras: Sequence[Camera], max_side: int, most_cut: float) -> list[Geometry]:
    """The views of photos; of one photo size, those that are smaller than the largest by at most
    `most_cut` of a side are cut to the smallest of these.

    Choices: where photos have focal lengths of their own, undistorted sizes differ by pixels.
    """
    shapes = {camera: geometry(camera, max_side) for camera in set(cameras)}
    for photo in {(camera.width, camera.height) for camera in shapes}:
        alike = [camera for camera in shapes if (camera.width, camera.height) == photo]
        sizes = np.array([[shapes[camera].width, shapes[camera].height] for camera in alike])
        near = (sizes >= (1 - most_cut) * sizes.max(0)).all(1)
        for k in np.flatnonzero(near):
            width, height = sizes[near].min(0).tolist()
            shapes[alike[k]] = replace(shapes[alike[k]], width=width, height=height)
    return [shapes[camera] for camera in cameras]


def positions(camera: Camera, view: Geometry) -> np.ndarray:
    """Positions f64 [2, H, W] (x, y), in photo pixels, of the centres of a view's pixels.

    Choices: -1 beyond the radius at which a distortion polynomial is no longer monotonic.
    """
    if camera.model not in DISTORTED:
        x = (np.arange(view.width) + 0.5) * camera.width / view.whole[0]
        y = (np.arange(view.height) + 0.5) * camera.height / view.whole[1]
        return np.stack(np.meshgrid(x, y))
    grid = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    pixels = np.stack([*grid, np.ones((view.height, view.width))], -1).reshape(-1, 3)
    distorted = camera.colmap.img_from_cam(pixels @ (camera.turned @ np.linalg.inv(view.K)).T)
    at = np.asarray(distorted, float).T.reshape(2, view.height, view.width)
    (x_down, x_right), (y_down, y_right) = (np.gradient(side) for side in at)
    plain = (
        (x_right > 0) & (y_down > 0) & (x_right * y_down > x_down * y_right)
    )  # not where at is nan
    return np.where(plain, at, -1.0)


def read_view(
    frame: Frame, listing: Listing, view: Geometry, at: np.ndarray, kinds: set[str]
) -> dict[str, np.ndarray]:
    """Maps of a view: images u8 [H, W, 3], loss_mask and opaque bool [H, W]; those of `kinds` that
    the frame has: depth, labels, pseudo_labels, confidence [H, W].
    """
    camera, size = frame.camera, (frame.camera.width, frame.camera.height)
    inside = within(at, size)
    pixels, opaque = photo(frame, listing, view, at)
    counts = inside & opaque.any()
    fields = {"images": pixels, "loss_mask": counts, "opaque": opaque}
    inside &= opaque  # of empty space there is no depth, nor a label
    if frame.mask is not None:
        counts &= companion(frame.mask, size, at) > 0
    if "depth" in kinds and frame.depth is not None and listing.depth_offset is not None:
        z = from_beside(frame.depth, listing, view)
        fields["depth"] = np.where(inside, z, np.float32(np.nan))
    elif "depth" in kinds and frame.depth is not None:
        place, field = at, size
        if listing.depth_camera is not None:
            place, field = moved(at, camera, listing.depth_camera)
        stored = companion(frame.depth, field, place, DEEP, "16-bit depth").astype(np.float32)
        valid = within(place, field) & inside & ~np.isin(stored, listing.no_depth)
        if frame.sureness is not None:
            valid &= companion(frame.sureness, field, place) > 0
        fields["depth"] = np.where(
            valid, stored / np.float32(listing.depth_scale), np.float32(np.nan)
        )
    if "labels" in kinds and frame.labels is not None:
        fields["labels"] = np.where(inside, labels.read(frame, listing, size, at), np.int32(-1))
    if (
        "pseudo_labels" in kinds
        and frame.pseudo_labels is not None
        and frame.confidence is not None
    ):
        ids = companion(frame.pseudo_labels, size, at, GREY, "8- or 16-bit ids")
        fields["pseudo_labels"] = np.where(inside, ids.astype(np.int32), np.int32(0))
        sure = nearest(confidences(frame.confidence), at, size)
        fields["confidence"] = np.where(inside & (fields["pseudo_labels"] > 0), sure, 0).astype(
            np.float16
        )
    return fields


def from_beside(path: Path, listing: Listing, view: Geometry) -> np.ndarray:
    """z-depth f32 [H, W] of a view by a depth camera beside it; nan where that measures none.

    Choices: of several depth pixels that project into one of the view the nearest counts.
    """
    camera = listing.depth_camera
    assert camera is not None and listing.depth_offset is not None
    own, pose = geometry(camera, max(camera.width, camera.height)), np.eye(4)
    stored = companion(path, (own.width, own.height), positions(camera, own), DEEP, "16-bit depth")
    pose[:3, 3] = -listing.depth_offset
    pixels = np.argwhere(~np.isin(stored, listing.no_depth))
    points = unproject(stored / listing.depth_scale, own.K, pose, pixels)
    projected = project(points, view.K, np.eye(4), (view.width, view.height))
    columns, rows, z = projected[np.isfinite(projected[:, 0])].T
    depth = np.full((view.height, view.width), np.nan, np.float32)
    np.fmin.at(depth, (rows.astype(int), columns.astype(int)), z.astype(np.float32))
    return depth


def photo(
    frame: Frame, listing: Listing, view: Geometry, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The view's pixels u8 [H, W, 3] and the mask of opaque ones [H, W]; frees the whole photo."""
    size = (frame.camera.width, frame.camera.height)
    with open_photo(frame.image, size, listing.upright) as (image, opaque):
        mask = np.ones(at.shape[1:], bool) if opaque is None else nearest(opaque, at, size)
        return resampled(image, frame.camera, view, at), mask


def variance_kept(image: Any, pixels: np.ndarray, at: np.ndarray) -> float:
    """Ratio of the variance of a view's grey values u8 [H, W, 3] to that of the part of its photo
    which it shows, at most 1: detail finer than its pixels is lost.

    Args: at [2, H, W]: positions of the view's pixels in the photo.
    Choices: the part is the box about these pixels. A photo of one grey value keeps all.
    """
    inside = np.where(at >= 0, at, np.nan)
    low, high = np.nanmin(inside, (1, 2)), np.nanmax(inside, (1, 2))
    half = (high - low) / np.maximum(2 * np.array(at.shape[:0:-1]) - 2, 1)  # of a pixel of the view
    corners = np.clip([np.floor(low - half), np.ceil(high + half)], 0, image.size).astype(int)
    part = image.convert("L").crop(corners.ravel().tolist())
    view = Image.fromarray(pixels).convert("L")
    whole, own = (ImageStat.Stat(of).var[0] for of in (part, view))
    return min(own / whole, 1.0) if whole > 0 else 1.0


def within(at: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Mask of positions [2, H, W] within an image of (width, height)."""
    return np.asarray(((at >= 0) & (at <= np.array(size)[:, None, None])).all(0))


def moved(at: np.ndarray, camera: Camera, other: Camera) -> tuple[np.ndarray, tuple[int, int]]:
    """Positions [2, H, W] of a pinhole camera in another at its centre, and the other's size."""
    (fx, fy, cx, cy), (gx, gy, dx, dy) = camera.pinhole, other.pinhole
    place = np.stack([(at[0] - cx) * (gx / fx) + dx, (at[1] - cy) * (gy / fy) + dy])
    return place, (other.width, other.height)


def resampled(image: Any, camera: Camera, view: Geometry, at: np.ndarray) -> np.ndarray:
    """The view u8 [H, W, 3] of an RGB photo, by area averages, undistorted where a lens bends it.

    Choices: a distorted photo is interpolated by cubic splines, in an image of 1.5 to 3 times the
      view's resolution: reduced to twice, as it is, or doubled by its cosine series, which is
      exact and slow. A pixel is the mean of four places in it, one for each quarter of its area;
      where it is as large as the photo's, the value at its centre.
    """
    if camera.model not in DISTORTED:
        same = view.whole == image.size
        whole = np.asarray(image if same else image.resize(view.whole, Image.Resampling.BOX))
        return whole[: view.height, : view.width]

    scale = min(2 * view.factor, 1.0)
    size = (max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
    small = np.asarray(
        image if size == image.size else image.resize(size, Image.Resampling.BOX), np.float32
    )
    doubled = view.factor > DOUBLED_ABOVE
    shape = [2 * side if doubled else side for side in small.shape[:2]]
    spans = np.array([camera.height, camera.width])[:, None, None]
    places = (at[::-1] * (np.array(shape)[:, None, None] / spans) - 0.5)[:, None]
    if view.factor < 1:
        away = (1 - view.factor / scale) / 2  # pixels of the view
        down, right = (away * np.gradient(places[:, 0], axis=axis) for axis in (1, 2))
        places = np.stack(
            [places[:, 0] + i * down + j * right for i in (-1, 1) for j in (-1, 1)], 1
        )
    means = []
    for finer in np.moveaxis(small, -1, 0):  # one by one: a photo at twice its resolution is large
        if doubled:
            finer = 2 * idctn(dctn(finer, norm="ortho"), s=shape, norm="ortho")
        means.append(map_coordinates(finer, places, np.float32, mode="nearest").mean(0))
    return np.stack(means, -1).round().clip(0, 255).astype(np.uint8)
