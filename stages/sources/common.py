"""What every source on disk shares: frames as a listing, the files behind them, and which kind a folder is."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.images import SUFFIXES, is_image
from chebsplat.formats.names import natural, unprintable
from chebsplat.formats.videos import SUFFIXES as VIDEOS
from chebsplat.formats.videos import is_video
from chebsplat.stages.settings import SourceSection
from chebsplat.stages.sources.cameras import Camera

# What cameras leave beside photos, or instead of them, and what makes JPEGs of it.
UNREAD = (
    dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), "darktable-cli a{0} a.jpg")
    | dict.fromkeys((".avif", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".jp2", ".jxl", ".exr", ".psd"),
                    "magick a{0} a.jpg")
)  # fmt: skip


@dataclass
class Frame:
    """One photo and what belongs to it. pose: cam_from_world [4, 4], OpenCV axes, nan if unusable; None if unknown."""

    name: str
    image: Path
    camera: Camera
    pose: np.ndarray | None = None
    depth: Path | None = None
    labels: Path | None = None
    mask: Path | None = None
    objects: Path | None = None  # ids of objects, as large as the labels
    pseudo_labels: Path | None = None  # what a 2D network took the photo for
    confidence: Path | None = None  # .npz whose `confidence` [h, w] says how sure it was


@dataclass
class Listing:
    """All frames of a source.

    label_names:  by raw id. class_names: all classes in order; None: those that occur.
    corrections:  object id -> raw id of the label that its pixels take instead.
    pseudo_names: by id in the pseudo labels; 0 is none.
    any_label_size: label images may have another resolution than their photos.
    depth_scale:  stored units in one scene unit; no_depth: stored values that mean "unknown".
    depth_camera: a pinhole camera of the depth images, at the photo's place; None: the photo's own.
    """

    kind: str
    frames: list[Frame]
    label_names: dict[int, str] | None = None
    class_names: tuple[str, ...] | None = None
    corrections: dict[int, int] = field(default_factory=dict)
    pseudo_names: dict[int, str] | None = None
    any_label_size: bool = False
    depth_scale: float = 1000.0
    no_depth: tuple[int, ...] = (0, 65_535)  # none, and what 16 bits hold no more of
    depth_camera: Camera | None = None
    notes: list[str] = field(default_factory=list)
    upright: bool = False  # turn every image by its EXIF orientation; otherwise only where its camera asks for it

    def has(self, what: str) -> bool:
        """Whether every frame has a "pose", "depth", "labels" and so on."""
        return bool(self.frames) and all(getattr(frame, what) is not None for frame in self.frames)


def stem(name: str) -> str:
    """A relative POSIX path without the suffix of an image; other dots are part of the name."""
    base, end = os.path.splitext(name)
    return base if end.lower() in SUFFIXES else name


def present(path: Path) -> bool:
    """Whether there is anything of that name: a pipe or a dangling link is refused when it is read, not passed over."""
    return os.path.lexists(path)


def nearest_file(folder: Path, name: str) -> Path | None:
    """A file that many scenes share: in the scene's folder or in one of the two above it."""
    places = (folder, *folder.absolute().parents[:2])
    return next((place / name for place in places if present(place / name)), None)


def detect(folder: Path) -> str:
    """The kind of source that a folder, or a file of video, is. Raises InputError naming what was looked for."""
    if present(folder / "transforms.json"):
        return "transforms"
    if any(present(folder / part) for part in ("traj.txt", "Sequence_1", "results")):
        return "replica"
    if all((folder / part).is_dir() for part in ("color", "pose", "intrinsic")):
        return "scannet"
    if (folder / "sparse").is_dir():
        return "colmap"
    if any(path.is_file() for place in ("", "seq-*/") for path in folder.glob(f"{place}frame-*.color.*")):
        return "seven_scenes"
    if folder.is_dir() and any(is_image(name) for name in os.listdir(folder)):
        return "photos"
    if is_video(folder.name) and folder.is_file():
        return "video"
    if folder.is_dir() and sum(is_video(name) for name in os.listdir(folder)) == 1:
        return "video"
    if others := unread(folder):
        raise InputError(f"{folder} holds no .jpg, .png or .heic photo: {others}")
    hint = f"; {folder / 'images'} may be meant" if (folder / "images").is_dir() else ""
    raise InputError(
        f"{folder} is no source: it holds neither transforms.json, traj.txt, results/, Sequence_1/, "
        f"color/ with pose/ and intrinsic/, frame-*.color.jpg or .png, sparse/0/cameras.bin or .txt, "
        f"nor a .jpg, .png or .heic photo, nor one video{hint}"
    )


def unread(folder: Path) -> str:
    """What else a folder and its images/ hold that may be taken for photos, counted by suffix; nothing of none."""
    places = [place for place in (folder, folder / "images") if place.is_dir()]
    ends = [os.path.splitext(name)[1].lower() for place in places for name in os.listdir(place) if name[0] != "."]
    counts = {end: n for end, n in sorted(Counter(ends).items()) if end in UNREAD or end in VIDEOS}
    if not counts:
        return ""
    how = dict.fromkeys(f"`{UNREAD[end].format(end)}`" for end in counts if end in UNREAD)
    remedies = [f"convert to JPEG, for example with {' and '.join(how)}"] if how else []
    if any(end in VIDEOS for end in counts):
        remedies.append("a video is read by itself, as scene=FOLDER/VIDEO")
    return f"{', '.join(f'{n} {end}' for end, n in counts.items())} not read; {'; '.join(remedies)}"


def names_below(folder: Path) -> Iterator[str]:
    """Relative POSIX paths of the images below a folder, in no order; none if it does not exist. InputError.

    Choices: a folder that is called like an image counts as one, so that reading it says so.
    """
    for place, folders, names in os.walk(folder):
        inner = os.path.relpath(place, folder).replace(os.sep, "/")
        images = filter(is_image, [*folders, *names])
        yield from printable(place, (name if inner == "." else f"{inner}/{name}" for name in images))


def printable(place: str | Path, names: Iterable[str]) -> Iterator[str]:
    """Names of files, which become names of views. Raises InputError on bytes that are no UTF-8, and on newlines."""
    for name in names:
        if unprintable(name):
            raise InputError(f"{place}: the file name {name!a} holds bytes that cannot be printed; rename the file")
        yield name


def images_in(folder: Path) -> list[str]:
    """As `names_below`, in natural order. Raises InputError if there are none."""
    if not folder.is_dir():
        raise InputError(f"{folder} is missing; the source needs its images there")
    found = sorted(names_below(folder), key=natural)
    if not found:
        raise InputError(f"{folder} holds no .jpg, .png or .heic image; correct source.path")
    return found


def resolve_source(name: str, source: SourceSection) -> SourceSection:
    """The source really meant: `named` is Replica's scene where REPLICA_ROOT holds it, else the generated one.

    The result, not `named`, enters an artifact's key, so the two can never be mistaken for each other.
    """
    if source.kind == "named":
        root = os.environ.get("REPLICA_ROOT")
        spellings = (name, name.rstrip("0123456789") + "_" + name[len(name.rstrip("0123456789")) :])
        existing = [Path(root) / s for s in spellings if root and (Path(root) / s).is_dir()]
        change = {"kind": "replica", "path": str(existing[0])} if existing else {"kind": "generated", "path": None}
        source = source.model_copy(update=change)
    if source.kind != "generated" and source.path is None:
        raise ConfigError(f"source.kind = {source.kind} needs source.path")
    return source
