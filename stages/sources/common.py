"""What every source on disk shares: a list of frames, and the way from frames to the fields of a capture."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chebsplat.errors import DataFailure, InputError

if TYPE_CHECKING:
    from chebsplat.stages.config import IngestSection

IMAGE_TYPES = (".jpg", ".jpeg", ".png")
PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
DISTORTED = {"SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8}
IGNORED = {"void", "ignore", "ignored", "unlabeled", "unlabelled", "undefined", "unknown"}


@dataclass
class Camera:
    """A COLMAP camera: model, its parameters in pixels with pixel centres at half integers, and the image's size."""

    model: str
    params: list[float]
    width: int
    height: int


@dataclass
class Frame:
    """One photo and what belongs to it. pose: cam_from_world [4, 4], OpenCV axes, or None."""

    name: str
    image: Path
    camera: Camera
    pose: np.ndarray | None = None
    depth: Path | None = None
    labels: Path | None = None
    mask: Path | None = None


@dataclass
class Listing:
    """All frames of a source. label_names: by raw id; depth_scale: stored units in one scene unit."""

    kind: str
    frames: list[Frame]
    label_names: dict[int, str] | None = None
    depth_scale: float = 1000.0
    notes: list[str] = field(default_factory=list)
    upright: bool = False  # turn images by their EXIF orientation

    def files(self) -> list[Path]:
        """Every image file that a capture depends on."""
        of = (path for f in self.frames for path in (f.image, f.depth, f.labels, f.mask) if path is not None)
        return sorted(of)

    def probe(self) -> dict[str, bool]:
        """What there is, by the names of files alone."""
        return {
            "poses": all(frame.pose is not None for frame in self.frames),
            "depth": all(frame.depth is not None for frame in self.frames),
            "labels": all(frame.labels is not None for frame in self.frames),
        }


def natural(name: str) -> list[Any]:
    """Sort key under which frame_2 precedes frame_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


def read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; the source is incomplete") from None
    except ValueError as error:
        raise InputError(f"{path} does not parse ({error}); restore the file") from None


def detect(folder: Path) -> str:
    """The kind of source a folder is. Raises InputError naming what was looked for."""
    if (folder / "transforms.json").is_file():
        return "transforms"
    if (folder / "traj.txt").is_file() or (folder / "Sequence_1/traj_w_c.txt").is_file():
        return "replica"
    if any(
        (folder / sparse / f"cameras.{end}").is_file() for sparse in ("sparse/0", "sparse") for end in ("bin", "txt")
    ):
        return "colmap"
    if folder.is_dir() and any(path.suffix.lower() in IMAGE_TYPES for path in folder.iterdir()):
        return "photos"
    raise InputError(
        f"{folder} is no source: neither transforms.json, sparse/0/cameras.bin or .txt, traj.txt, nor a photo is there"
    )


def images_in(folder: Path) -> list[Path]:
    """Images of a folder and its subfolders in natural order. Raises InputError if there are none."""
    if not folder.is_dir():
        raise InputError(f"{folder} is missing; the source needs its images there")
    found = [path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_TYPES]
    if not found:
        raise InputError(f"{folder} holds no .jpg or .png image")
    return sorted(found, key=lambda path: natural(path.relative_to(folder).as_posix()))


def beside(folder: Path, stem: str) -> Path | None:
    """The PNG of a name in a folder that may not exist."""
    path = folder / f"{stem}.png"
    return path if path.is_file() else None


def assemble(listing: Listing, settings: IngestSection) -> dict[str, Any]:
    """Read all frames into the fields of a capture.

    Choices: frames sorted naturally; `max_views` picks them evenly; each is reduced to `max_side` by averaging
      (labels and depth by the nearest pixel), then undistorted; smaller ones are padded at the right and the
      bottom, where their loss mask is false. Depth, labels and masks are taken only if every frame has them.
    Raises:  InputError naming a bad file, DataFailure under `min_views`.
    """
    notes = list(listing.notes)
    frames = [frame for frame in listing.frames if frame.pose is None or np.isfinite(frame.pose).all()]
    if len(frames) < len(listing.frames):
        notes.append(f"{len(listing.frames) - len(frames)} frames have a pose that is not finite and are left out.")
    if len(frames) < settings.min_views:
        raise DataFailure(f"{len(frames)} usable frames; ingest.min_views is {settings.min_views}. {' '.join(notes)}")
    frames = sorted(frames, key=lambda frame: natural(frame.name))
    if settings.max_views is not None and len(frames) > settings.max_views:
        picked = np.linspace(0, len(frames) - 1, settings.max_views).round().astype(int)
        notes.append(f"{len(picked)} of {len(frames)} views are used (ingest.max_views).")
        frames = [frames[k] for k in picked]
    has = Listing(listing.kind, frames).probe()
    views = [View(frame, listing, settings.max_side, has) for frame in frames]
    height, width = (max(view.image.shape[axis] for view in views) for axis in (0, 1))
    fields: dict[str, Any] = {
        "names": [frame.name for frame in frames],
        "images": np.stack([padded(view.image, height, width, 0) for view in views]),
        "Ks": np.stack([view.K for view in views]),
        "cam_from_world": np.stack([frame.pose for frame in frames]) if has["poses"] else None,  # type: ignore[misc]
    }
    if has["depth"]:
        fields["depth"] = np.stack([padded(view.depth, height, width, np.nan) for view in views])
    if has["labels"]:
        raw = np.stack([padded(view.labels, height, width, -1) for view in views])
        fields["labels"], fields["class_names"] = contiguous(raw, listing.label_names)
    masks = np.stack([padded(view.mask, height, width, False) for view in views])
    if not masks.all():
        fields["loss_mask"] = masks
        notes.append(f"{1 - masks.mean():.1%} of the pixels are masked.")
    if any(view.factor < 1 for view in views):
        notes.append(f"Images are reduced by {min(view.factor for view in views):.3f} (ingest.max_side).")
    if any(frame.camera.model in DISTORTED for frame in frames):
        notes.append(f"Images are undistorted ({frames[0].camera.model}).")
    return fields | {"source": {"kind": listing.kind, "notes": notes}}


class View:
    """One frame, read, reduced and undistorted: image u8, K, mask bool, depth f32 and labels i32 where asked for."""

    def __init__(self, frame: Frame, listing: Listing, max_side: int, has: dict[str, bool]):
        camera = frame.camera
        if camera.model not in PINHOLES and camera.model not in DISTORTED:
            raise InputError(
                f"{frame.image}: camera model {camera.model} is not supported ({', '.join([*PINHOLES, *DISTORTED])} "
                "are); undistort the images with COLMAP first"
            )
        image = open_image(frame.image, listing.upright).convert("RGB")
        if image.size != (camera.width, camera.height):
            raise InputError(f"{frame.image} is {image.size}, its camera {(camera.width, camera.height)}; restore it")
        self.factor = min(1.0, max_side / max(image.size))
        size = tuple(max(round(n * self.factor), 1) for n in image.size)
        from PIL import Image

        self.image = np.asarray(image if size == image.size else image.resize(size, Image.Resampling.BOX))
        fx, fy, cx, cy = pinhole_params(camera)
        sx, sy = size[0] / image.size[0], size[1] / image.size[1]
        self.K = np.array([[fx * sx, 0, cx * sx], [0, fy * sy, cy * sy], [0, 0, 1.0]])
        self.mask = np.ones(self.image.shape[:2], bool)
        if frame.mask is not None:
            self.mask = nearest(frame.mask, image.size, size) > 0
        if has["depth"] and frame.depth is not None:
            stored = nearest(frame.depth, image.size, size).astype(np.float32)
            self.depth = np.where(stored > 0, stored / np.float32(listing.depth_scale), np.float32(np.nan))
        if has["labels"] and frame.labels is not None:
            self.labels = nearest(frame.labels, image.size, size).astype(np.int32)
        if camera.model in DISTORTED:
            self._undistort(camera, sx, sy)

    def _undistort(self, camera: Camera, sx: float, sy: float) -> None:
        """Sample everything at where the pixels of the matching pinhole camera lie in the distorted image."""
        import pycolmap
        from scipy.ndimage import map_coordinates

        height, width = self.image.shape[:2]
        params = list(camera.params)
        lengths = {"SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2}[camera.model]
        scales = [sx, sy] if lengths == 2 else [sx]
        params[: lengths + 2] = [v * s for v, s in zip(params[: lengths + 2], [*scales, sx, sy], strict=True)]
        distorted = pycolmap.Camera(model=camera.model, width=width, height=height, params=params)
        options = pycolmap.UndistortCameraOptions()
        options.blank_pixels = 0.0
        plain = pycolmap.undistort_camera(options, distorted)
        y, x = np.mgrid[: plain.height, : plain.width] + 0.5
        rays = plain.cam_from_img(np.stack([x.ravel(), y.ravel()], 1))
        rays = np.concatenate([np.asarray(rays, float), np.ones((len(rays), 1))], 1)
        source = np.asarray(distorted.img_from_cam(rays), float).reshape(plain.height, plain.width, 2)
        at = [source[..., 1] - 0.5, source[..., 0] - 0.5]

        def sampled(data: np.ndarray, order: int) -> np.ndarray:
            return map_coordinates(data, at, order=order, mode="nearest")

        self.image = np.stack([sampled(self.image[..., c], 1) for c in range(3)], -1)
        outside = (source < 0).any(-1) | (source[..., 0] > width) | (source[..., 1] > height)
        self.mask = sampled(self.mask.astype(np.uint8), 0).astype(bool) & ~outside
        for name in ("depth", "labels"):
            if hasattr(self, name):
                setattr(self, name, sampled(getattr(self, name), 0))
        self.K = plain.calibration_matrix()


def pinhole_params(camera: Camera) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy."""
    p = camera.params
    return (p[0], p[1], p[2], p[3]) if camera.model in ("PINHOLE", "OPENCV") else (p[0], p[0], p[1], p[2])


def open_image(path: Path, upright: bool = False) -> Any:
    from PIL import Image, ImageOps

    try:
        with path.open("rb") as handle:
            image = Image.open(handle)
            image.load()
    except FileNotFoundError:
        raise InputError(f"{path} is missing; the source is incomplete") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path} is not a readable image ({error}); copy it again") from None
    return ImageOps.exif_transpose(image) if upright else image


def nearest(path: Path, full: tuple[int, int], size: tuple[int, ...]) -> np.ndarray:
    """A single-channel image that must be as large as its photo, at the reduced size."""
    data = np.asarray(open_image(path))
    if data.ndim != 2 or data.shape[::-1] != full:
        raise InputError(f"{path} is {data.shape}, its photo (width, height) {full}; restore it")
    rows = np.minimum(((np.arange(size[1]) + 0.5) * full[1] / size[1]).astype(int), full[1] - 1)
    columns = np.minimum(((np.arange(size[0]) + 0.5) * full[0] / size[0]).astype(int), full[0] - 1)
    return data[rows[:, None], columns]


def padded(data: np.ndarray, height: int, width: int, value: Any) -> np.ndarray:
    """Grown to height x width at the bottom and the right."""
    if data.shape[:2] == (height, width):
        return data
    out = np.full((height, width, *data.shape[2:]), value, data.dtype)
    out[: data.shape[0], : data.shape[1]] = data
    return out


def contiguous(raw: np.ndarray, names: dict[int, str] | None) -> tuple[np.ndarray, list[str]]:
    """Raw ids to indices of the classes that occur; ignored ones and ids without a name become -1.

    Choices: without any names, id k is called class_k and 0 is ignored.
    """
    present = [int(v) for v in np.unique(raw) if v >= 0]
    known = names if names is not None else {v: f"class_{v}" for v in present if v != 0}
    kept = [v for v in present if v in known and known[v].lower() not in IGNORED]
    table = np.full(max([*present, 0]) + 2, -1, np.int16)
    class_names: list[str] = []
    for value in kept:
        if known[value] not in class_names:
            class_names.append(known[value])
        table[value] = class_names.index(known[value])
    return table[np.where(raw < 0, -1, raw)], class_names
