"""Shared parts of sources on disk: listings of frames, their files, detection of the kind."""

from __future__ import annotations

import itertools
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.images import SUFFIXES, is_image
from chebsplat.formats.names import natural, unprintable
from chebsplat.formats.videos import SUFFIXES as VIDEOS
from chebsplat.formats.videos import is_video
from chebsplat.stages.settings import SourceSection
from chebsplat.stages.sources.cameras import Camera

OWN_SIDE = 1600  # pixels: size limit of photos as taken, as in published comparisons
# folders of label maps; the first that exists is read
LABELS = (
    "semantic",
    "semantics",
    "semantic_class",
    "label",
    "labels",
    "segmentation",
    "segmentations",
)
# folders of images that are no photos
BESIDE = {
    "masks",
    "mask",
    "depth",
    "depths",
    "confidence",
    "instance",
    "normals",
    "thumbs",
    "thumbnails",
    *LABELS,
}
LabelFile = Path | dict[str, Path]  # a view's map, or its masks by class
ENDING = re.compile(r"\.[a-zA-Z]\w{1,4}$")  # of an image's name
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
PICTURES = (".avif", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".jp2", ".jxl", ".exr", ".psd")
# suffixes of images that are not read: the command that makes JPEGs of them
UNREAD = dict.fromkeys(RAW, "darktable-cli a{0} a.jpg") | dict.fromkeys(
    PICTURES, "magick a{0} a.jpg"
)


@dataclass
class Frame:
    """A photo and its files. pose: cam_from_world [4, 4], OpenCV axes; nan invalid; or None."""

    name: str
    image: Path
    camera: Camera
    pose: np.ndarray | None = None
    depth: Path | None = None
    labels: LabelFile | None = None
    mask: Path | None = None
    objects: Path | None = None  # ids of objects, as large as the labels
    pseudo_labels: Path | None = None  # of a 2D network
    confidence: Path | None = None  # .npz with the pseudo labels' `confidence` [h, w]
    sureness: Path | None = None  # a LiDAR's confidence in its depth, 0: invalid


class Shot(NamedTuple):
    """A photo without pose. size: (width, height), upright; focal: 35 mm equivalent, by EXIF;
    panorama: true if of all directions; frame: its number in a video.
    """

    name: str
    path: Path
    size: tuple[int, int]
    focal: float | None = None
    mask: Path | None = None
    panorama: bool = False
    frame: int = 0

    def reduced(self, max_side: int) -> tuple[int, int]:
        """(width, height), reduced until no side exceeds `max_side`."""
        factor = min(1.0, max_side / max(self.size))
        return max(round(self.size[0] * factor), 1), max(round(self.size[1] * factor), 1)


@dataclass
class Listing:
    """All frames of a source.

    label_names:  by raw id; label_place: the folder of their maps; label_kinds: of the maps, by
                  view, once read (`labels.read`).
    class_names:  all classes in order; None: those that occur.
    corrections:  object id -> raw id of the label that its pixels take instead.
    pseudo_names: by id in the pseudo labels; 0 is none.
    depth_scale:  stored units in one scene unit; no_depth: stored values that mean "unknown".
    depth_camera: a pinhole camera of the depth images; None: the photo's own.
    depth_offset: its centre in the photo's camera [3], scene units; None: the same centre.
    """

    kind: str
    frames: list[Frame]
    label_names: dict[int, str] | None = None
    label_place: str = ""
    label_kinds: dict[str, str] = field(default_factory=dict)
    class_names: tuple[str, ...] | None = None
    corrections: dict[int, int] = field(default_factory=dict)
    pseudo_names: dict[int, str] | None = None
    depth_scale: float = 1000.0
    no_depth: tuple[int, ...] = (0, 65_535)  # none, and beyond 16 bits
    depth_camera: Camera | None = None
    depth_offset: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)
    # by view: mask of transparent pixels of its photo, once read
    empty: dict[str, np.ndarray] = field(default_factory=dict)
    # turn every image by its EXIF orientation; otherwise only those that fit their camera so
    upright: bool = False

    def has(self, what: str) -> bool:
        """True where every frame has a "pose", "depth", "labels" and so on."""
        return bool(self.frames) and all(getattr(frame, what) is not None for frame in self.frames)


def sureness(depth: Path) -> Path | None:
    """A LiDAR's confidence in a depth map, in confidence/ beside its folder, if there is one."""
    path = depth.parent.with_name("confidence") / depth.name
    return path if depth.parent.name.startswith("depth") and present(path) else None


def file_of(view: int) -> str:
    """A view's image in the scratch folder: pycolmap's lists of pairs allow no spaces in names."""
    return f"{view:06d}.png"


def is_photo(path: Path, root: Path) -> bool:
    """True for an image below a source's folder that is by its path no mask, depth or label map."""
    return BESIDE.isdisjoint(re.findall("[a-z]+", str(path.relative_to(root)).lower()))


def stem(name: str) -> str:
    """A relative POSIX path without the suffix of an image; other dots are part of the name."""
    base, end = os.path.splitext(name)
    return base if end.lower() in SUFFIXES else name


def distinct(named: Iterable[tuple[str, Path]]) -> None:
    """Raise InputError where two files, in the order of their names, are one view."""
    for (name, first), (other, second) in itertools.pairwise(named):
        if name == other:
            raise InputError(f"{first} and {second} are both view {name}; rename or remove one")


def present(path: Path) -> bool:
    """True where anything of that name exists: a pipe or a dangling link fails when it is read."""
    return os.path.lexists(path)


def nearest_file(folder: Path, name: str) -> Path | None:
    """A file shared by scenes: in the scene's folder or in one of the two above it."""
    places = (folder, *folder.absolute().parents[:2])
    return next((place / name for place in places if present(place / name)), None)


def detect(folder: Path) -> str:
    """Kind of source of a folder, or of a file of video. Raises InputError naming all signs."""
    if any(present(folder / f"transforms{part}.json") for part in ("", "_train")):
        return "transforms"
    if any(present(folder / part) for part in ("traj.txt", "Sequence_1", "results")):
        return "replica"
    if all((folder / part).is_dir() for part in ("color", "pose", "intrinsic")):
        return "scannet"
    if (folder / "sparse").is_dir() or (folder / "colmap/sparse").is_dir():
        return "colmap"
    if any(
        path.is_file()
        for place in ("", "seq-*/")
        for path in folder.glob(f"{place}frame-*.color.*")
    ):
        return "seven_scenes"
    if folder.is_dir() and (
        any(map(is_image, os.listdir(folder))) or any(names_below(photo_folder(folder)))
    ):
        return "photos"
    if is_video(folder.name) and folder.is_file():
        return "video"
    if folder.is_dir() and sum(is_video(name) for name in os.listdir(folder)) == 1:
        return "video"
    if folder.is_dir() and set(with_photos(folder)) - BESIDE:
        return "photos"
    if (folder / "point_cloud").is_dir():
        raise InputError(
            f"{folder} is a splat of 3DGS and no source: `chebsplat view` shows it, `chebsplat "
            "lift` takes it"
        )
    if others := unread(folder):
        raise InputError(f"{folder} holds no .jpg, .png or .heic photo: {others}")
    raise InputError(
        f"{folder} is no source: it holds neither transforms.json, traj.txt, results/, "
        "Sequence_1/, color/ with pose/ and intrinsic/, frame-*.color.jpg or .png, "
        "sparse/0/cameras.bin or .txt, nor a .jpg, .png or .heic photo, nor one video"
    )


def unread(folder: Path) -> str:
    """Unsupported images in a folder and its images/ by suffix, with a remedy; "" if none."""
    places = [place for place in (folder, folder / "images") if place.is_dir()]
    ends = [
        os.path.splitext(name)[1].lower()
        for place in places
        for name in os.listdir(place)
        if name[0] != "."
    ]
    counts = {end: n for end, n in sorted(Counter(ends).items()) if end in UNREAD or end in VIDEOS}
    if not counts:
        return ""
    how = dict.fromkeys(f"`{UNREAD[end].format(end)}`" for end in counts if end in UNREAD)
    remedies = [f"convert to JPEG, for example with {' and '.join(how)}"] if how else []
    if any(end in VIDEOS for end in counts):
        remedies.append("a video is read by itself, as scene=FOLDER/VIDEO")
    return f"{', '.join(f'{n} {end}' for end, n in counts.items())} not read; {'; '.join(remedies)}"


def names_below(folder: Path) -> Iterator[str]:
    """Relative POSIX paths of the images below a folder, unordered; none if it does not exist.

    Choices: a folder named like an image counts as one, so that reading it reports it.
    """
    for place, folders, names in os.walk(folder):
        inner = os.path.relpath(place, folder).replace(os.sep, "/")
        images = filter(is_image, [*folders, *names])
        yield from printable(
            place, (name if inner == "." else f"{inner}/{name}" for name in images)
        )


def printable(place: str | Path, names: Iterable[str]) -> Iterator[str]:
    """The names of files. Raises InputError on bytes that are no UTF-8 and on newlines."""
    for name in names:
        if unprintable(name):
            raise InputError(
                f"{place}: the file name {name!a} holds bytes that cannot be "
                "printed; rename the file"
            )
        yield name


def images_in(folder: Path) -> list[str]:
    """As `names_below`, in natural order. Raises InputError if there are none."""
    if not folder.is_dir():
        raise InputError(f"{folder} is missing; the source needs its images there")
    names = sorted(names_below(folder), key=natural)
    if not names:
        raise InputError(f"{folder} holds no .jpg, .png or .heic image; correct source.path")
    return names


def photo_folder(folder: Path) -> Path:
    """Folder of a source's photos: images/, input/ of 3DGS' converter, or a reduced copy."""
    places = [folder / name for name in ("images", "input", "images_2", "images_4", "images_8")]
    return next((place for place in places if any(names_below(place))), places[0])


def with_photos(folder: Path) -> list[str]:
    """Subfolders that hold images, masks/ left out, in natural order."""
    with os.scandir(folder) as entries:
        names = [
            entry.name
            for entry in entries
            if entry.is_dir() and entry.name[0] != "." and entry.name != "masks"
        ]
    return sorted(
        (name for name in names if any(map(is_image, os.listdir(folder / name)))), key=natural
    )


def matched(listed: Sequence[str], there: Collection[str]) -> dict[str, str]:
    """Files by the names that a model lists; names without a file are omitted.

    Args: there: POSIX paths of files below the folder that the names are relative to.
    Choices: a name is a path with either separator. Where that is no file, endings are dropped, and
      then folders, one by one from the front, until it fits one file alone, and no other name does.
    """
    files = set(there)
    matches = {name: path for name in listed if (path := name.replace("\\", "/")) in files}
    for depth in range(1 + max((name.count("/") for name in files), default=0), 0, -1):
        places: list[dict[tuple[str, ...], list[str]]] = []
        for names in (set(listed) - set(matches), files - set(matches.values())):
            places.append({})
            for name in names:
                parts = tuple(ENDING.sub("", name.replace("\\", "/")).casefold().split("/"))
                if len(parts) >= depth:
                    places[-1].setdefault(parts[-depth:], []).append(name)
        for key, names_of in places[0].items():
            if len(names_of) == len(places[1].get(key, ())) == 1:
                matches[names_of[0]] = places[1][key][0]
    return matches


def masks_in(folder: Path, names: Iterable[str]) -> tuple[dict[str, Path], list[str]]:
    """Masks by photo, in masks/ and named like it or its stem; a note if some photos have none."""
    masks = {stem(name): folder / "masks" / name for name in names_below(folder / "masks")}
    photos = list(names)
    matches = {name: path for name in photos if (path := masks.get(name) or masks.get(stem(name)))}
    lacking = len(photos) - len(matches)
    return matches, [
        f"{lacking} of {len(photos)} views have no mask; all their pixels count."
    ] if masks and lacking else []


def spellings(name: str) -> tuple[str, str]:
    """A scene's name, and with `_` before its number: `office0` is `office_0` to Semantic-NeRF."""
    letters = name.rstrip("0123456789")
    return name, f"{letters}_{name[len(letters) :]}"


def resolve_source(name: str, source: SourceSection) -> SourceSection:
    """The source, `named` resolved: Replica's scene if REPLICA_ROOT has it, else a generated one.

    The resolved source enters an artifact's key, so that the two are never confused.
    """
    if source.kind == "named":
        root = os.environ.get("REPLICA_ROOT")
        existing = [Path(root) / s for s in spellings(name) if root and (Path(root) / s).is_dir()]
        change = (
            {"kind": "replica", "path": str(existing[0])}
            if existing
            else {"kind": "generated", "path": None}
        )
        source = source.model_copy(update=change)
    if source.kind != "generated" and source.path is None:
        raise ConfigError(f"source.kind = {source.kind} needs source.path")
    return source
