"""Folders of photos and data sets that nothing could be made of, met by the ingest stage, some by
`plan`.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import layouts
import numpy as np
from source_folders import image, tiny, write_colmap, write_transforms

from malformed.edits import (
    DEEP,
    EPS,
    Edit,
    all_of,
    changed,
    cut,
    declared_png,
    keys,
    no_file,
    npy,
    npz,
    picture,
    put,
    remove,
    swollen,
)
from malformed.row import Arguments, Row, stage

NAN, INF = float("nan"), float("inf")
# the file or setting that is named, what is wrong with it, the edit or the file's content, a word
# of the message
Case = tuple[str, str, Edit | str | bytes, str]


def met(
    write: Callable[[Path], Any],
    cases: Iterable[Case],
    code: int = 3,
    alone: bool = False,
    plan: bool = False,
    **settings: Any,
) -> Iterator[Row]:
    """Each case of a folder that `write` makes, met by ingest, or by `plan`; alone: in a process of
    its own.
    """
    kind, (_, layout, _) = next((kind, whole) for kind, whole in WHOLE.items() if whole[0] is write)
    for named, what, edit, word in cases:

        def build(folder: Path, edit: Edit | str | bytes = edit, named: str = named) -> Arguments:
            source = folder / "shared/scene"  # tables may lie beside a scene
            source.mkdir(parents=True)
            write(source)
            edit(source) if callable(edit) else put(named, edit)(source)
            if plan:
                return ["plan", "--scene", f"{source}/"]
            section = {"kind": layout, "path": str(source)}
            if layout == "photos":  # which come alone: ingest has no model of them yet
                return stage("pose", folder, {"source": section})
            return stage(
                "ingest", folder, {"source": section, "ingest": {"min_views": 2} | settings}
            )

        yield Row(kind, f"{named}: {what}{', in plan' * plan}", build, (named, word), code, alone)


# photos, and the images beside them

NO_IMAGE, BROKEN = "no PNG, JPEG or HEIC image", "not a readable image"
MODES = {"depth": "I;16", "semantic": "L", "masks": "L"}


def write_photos(source: Path) -> None:
    for name in ("a.jpg", "b.jpg", "c.png"):
        picture(name, form="JPEG" if name.endswith("jpg") else "PNG")(source)


def write_companions(source: Path) -> None:
    write_colmap(source)
    for name in "abc":
        image(source / f"masks/{name}.png", mode="L", value=255)


def called_by(raw: bytes) -> Edit:
    """A photo under a name of any bytes."""
    return lambda source: os.rename(source / "b.jpg", os.path.join(os.fsencode(source), raw))


def instead(*names: str) -> Edit:
    """Other files where the photos were."""
    return all_of(
        *map(remove, ("a.jpg", "b.jpg", "c.png")), *(put(name, b"\0" * 64) for name in names)
    )


def photos() -> Iterator[Row]:
    yield from met(write_photos, [
        ("b.jpg", "nothing", b"", NO_IMAGE),
        ("b.jpg", "a web page", "<!doctype html><title>404</title>", NO_IMAGE),
        ("b.jpg", "an EPS", EPS, NO_IMAGE),
        ("b.jpg", "a pickle", b"cos\nsystem\n(S'exit 1'\ntR.", NO_IMAGE),
        ("b.jpg", "a GIF", picture("b.jpg", form="GIF"), NO_IMAGE),
        ("b.jpg", "a JPEG's first bytes", b"\xff\xd8\xff\xe0\0\x10JFIF", BROKEN),
        ("b.jpg", "a JPEG cut short", cut("b.jpg", 300), BROKEN),
        ("b.jpg", "a folder", no_file("b.jpg", "folder"), "is a folder"),
        ("b.jpg", "a looping link", no_file("b.jpg", "looping link"), "symbolic links"),
        ("b.jpg", "two suffixes of one name", picture("b.png"), "are both view b"),
        ("c.png", "16 bits", picture("c.png", mode="I;16"), "convert it to 8 bits"),
        ("c.png", "70,000 columns", picture("c.png", (70_000, 1)), "65535 pixels a side"),
        ("c.png", "65 million pixels", picture("c.png", (65_000, 1001), mode="1"), "64 megapixels"),
        ("photo", "a name that is no UTF-8", called_by(b"photo\xff\xfe.jpg"), "cannot be printed"),
    ])  # fmt: skip
    alone: list[Case] = [("photos", "of one colour", put("d.txt", ""), "could be registered")]
    yield from met(write_photos, alone, 4)
    bombs = {"10,000 million pixels": (100_000, 100_000), "177 million pixels": (13_300, 13_300),
             "2^31 columns": (2**31 - 1, 1)}  # fmt: skip
    heavy: list[Case] = [
        ("b.jpg", what, declared_png(*size), "too large") for what, size in bombs.items()
    ]
    heavy.append(("b.jpg", "rows that it has not", declared_png(4000, 4000), BROKEN))
    heavy.append(("b.jpg", "a terabyte", all_of(put("b.jpg", ""), swollen("b.jpg")), NO_IMAGE))
    heavy += [("b.jpg", f"a {kind}", no_file("b.jpg", kind), "a pipe, a socket or a device")
              for kind in ("pipe", "device")]  # fmt: skip
    yield from met(write_photos, heavy, alone=True)
    yield from met(write_photos, heavy[-2:-1], alone=True, plan=True)
    others: list[Case] = [(f"1 .{end.lower()}", "alone", instead(f"a.{end}"), f"a.{end.lower()}")
                          for end in ("avif", "tif", "CR2")]  # fmt: skip
    others.append(("2 .mov", "alone", instead("a.MOV", "b.MOV"), "a video is read by itself"))
    yield from met(
        write_photos, [*others, ("scene", "nothing", instead(), "is no source")], plan=True
    )


def companions() -> Iterator[Row]:
    one = all_of(remove("images/a.png"), remove("images/b.png"))
    yield from met(write_companions, [("ingest.min_views", "one photo", one, "1 usable frames")], 4)
    yield from met(
        write_companions,
        [("ingest.test_every", "all are test views", one, "all of them")],
        4,
        min_views=1,
    )
    none = ("ingest.test_offset", "no test view", put("d.txt", ""), "none of them")
    yield from met(write_companions, [none], 4, test_offset=7)
    cases: list[Case] = []
    for place, mode in MODES.items():
        path = f"{place}/b.png"
        cases += [
            (path, "text", "depth", NO_IMAGE),
            (path, "cut short", cut(path, 30), BROKEN),
            (path, "turned", picture(path, (6, 8), mode), "is 6x8, its photo 8x6"),
            (path, "a looping link", no_file(path, "looping link"), "symbolic links"),
        ]
    depth, labels = "depth/b.png", "semantic/b.png"
    cases += [
        (depth, "missing", remove(depth), "is missing"),
        (depth, "8 bits", picture(depth, mode="L"), "16-bit depth"),
        (depth, "coloured", picture(depth), "16-bit depth"),
        (labels, "of a photo", picture(labels, form="JPEG"), "is a JPEG picture"),
        (
            labels,
            "an array beside it",
            put("semantic/b.npy", npy(np.zeros((6, 8), np.uint8))),
            "are both view",
        ),
        ("semantic/", "one is coloured", picture(labels), "several kinds: colours (b), ids (a, c)"),
        (
            "semantic/",
            "of other photos",
            all_of(*(remove(f"semantic/{n}.png") for n in "abc"), picture("semantic/z.png")),
            "none is called like a photo",
        ),
        *(
            (path, what, all_of(remove(labels), put(path, npy(values))), word)
            for path, what, values, word in (
                (
                    "semantic/b.npy",
                    "of a photo's transpose",
                    np.zeros((8, 6), np.uint8),
                    "is 6x8, its photo 8x6",
                ),
                ("semantic/b.npy", "halves", np.full((6, 8), 0.5), "no ids"),
                ("semantic/b.npy", "nan", np.full((6, 8), NAN), "not finite"),
                (
                    "semantic/b.npy",
                    "scores of another shape",
                    np.zeros((4, 4, 4)),
                    "has not the shape",
                ),
                ("semantic/b.npy", "words", np.array(["sofa"]), "neither ids nor scores"),
            )
        ),
        (
            "semantic/b.npy",
            "cut short",
            all_of(remove(labels), put("semantic/b.npy", b"\x93NUMPY")),
            "not a readable",
        ),
    ]
    yield from met(write_companions, cases)
    heavy: list[Case] = [(f"{place}/b.png", "10,000 million pixels",
                          declared_png(100_000, 100_000, 0), "too large")
                         for place in MODES]  # fmt: skip
    yield from met(write_companions, heavy, alone=True)
    black = all_of(*(picture(f"masks/{n}.png", mode="L") for n in "abc"))
    clear = all_of(*(picture(f"images/{n}.png", mode="RGBA") for n in "abc"), remove("masks"))
    yield from met(write_companions, [
        ("masks/a.png", "all are black", black, "no pixel of any view counts"),
        ("images/a.png", "all are transparent", clear, "no pixel of any view counts"),
        ("ids [7]", "no label has a name", put("labels.json", '{"3": "sofa"}'),
         "no label has a name"),
    ], 4)  # fmt: skip


# COLMAP

PINHOLE, OPENCV = 1, 4
MODEL = "sparse/0"
NAMES = (b"a.png", b"b.png", b"c.png")


def camera(
    kind: int = PINHOLE, size: tuple[int, int] = (8, 6), params: tuple[float, ...] = (10, 10, 4, 3)
) -> bytes:
    return struct.pack(f"<QIiQQ{len(params)}d", 1, 1, kind, *size, *params)


def views(
    names: tuple[bytes, ...] = NAMES,
    quaternion: tuple[float, ...] = (1, 0, 0, 0),
    place: tuple[float, ...] = (0, 0, 0),
    of: int = 1,
    n_keypoints: int = 1,
) -> bytes:
    """Three posed images; all but the names are the last one's."""
    found = struct.pack("<Q", len(names))
    for k, name in enumerate(names):
        last = k == len(names) - 1
        pose = (*quaternion, *place) if last else (1, 0, 0, 0, k, 0, 0)
        found += struct.pack("<I7dI", k + 1, *pose, of if last else 1) + name + b"\0"
        found += struct.pack("<Q2dQ", n_keypoints if last else 1, 1, 1, 1)
    return found


def points(n_tracks: int = 1) -> bytes:
    return struct.pack("<QQ3d3BdQII", 1, 1, 0, 0, 2, 9, 9, 9, 0.5, n_tracks, 1, 0)


PARTS = {
    f"{MODEL}/cameras.bin": camera(),
    f"{MODEL}/images.bin": views(),
    f"{MODEL}/points3D.bin": points(),
}
NO_MODEL, NO_CAMERA, NO_POSE = (
    "cut or no COLMAP model",
    "is not usable",
    ("no rotation and translation"),
)


def write_model(source: Path) -> None:
    for name in NAMES:
        image(source / "images" / name.decode())
    for place, content in PARTS.items():
        put(place, content)(source)


def colmap() -> Iterator[Row]:
    cameras, images, cloud = PARTS
    cases: list[Case] = []
    for place, content in PARTS.items():
        cases += [
            (place, "empty", b"", NO_MODEL),
            (place, "cut in a record", content[:-30], NO_MODEL),
            (place, "2^64 - 1 records", struct.pack("<Q", 2**64 - 1), NO_MODEL),
        ]
    for what, values, word in (
        ("no known model", (99,), "no known model"),
        ("2^63 rows", (PINHOLE, (8, 2**63)), NO_CAMERA),
        ("f = 1e300", (PINHOLE, (8, 6), (1e300, 10, 4, 3)), "focal length"),
        ("f = nan", (PINHOLE, (8, 6), (NAN, 10, 4, 3)), "no numbers"),
        ("k1 = 1e300", (OPENCV, (8, 6), (10, 10, 4, 3, 1e300, 0, 0, 0)), "distortion"),
    ):
        cases.append((cameras, what, camera(*values), word))  # type: ignore[arg-type]
    cases += [
        (images, "a camera that is not there", views(of=7), "'c.png' is of camera 7"),
        (images, "a quaternion of nan", views(quaternion=(NAN, 0, 0, 0)), NO_POSE),
        (images, "a quaternion of length 2", views(quaternion=(1, 1, 1, 1)), NO_POSE),
        (images, "1e30 away", views(place=(1e30, 0, 0)), "c.png lies 1e+30 units"),
        (images, "2^40 keypoints", views(n_keypoints=2**40), NO_MODEL),
        (images, "a name without an end", views()[:72] + b"a" * 10**6, NO_MODEL),
        (cloud, "missing", remove(cloud), "is missing"),
        (cloud, "a track of 2^40", points(2**40), NO_MODEL),
        (
            "images/a.png",
            "another size",
            put(cameras, camera(size=(80, 66), params=(100, 100, 40, 30))),
            "80x66",
        ),
    ]
    yield from met(write_model, cases)
    outside = {
        "climb out": b"../../../etc/x.png",
        "are absolute": b"/etc/x.png",
        "are no UTF-8": b"\xff",
    }
    few: list[Case] = [("ingest.min_views", f"names that {what}", put(images, views((name,) * 3)),
                        "absent on disk")
                       for what, name in outside.items()]  # fmt: skip
    yield from met(write_model, few, 4)
    heavy: list[Case] = [
        (place, "a terabyte", swollen(place), "more than 512 MiB") for place in PARTS
    ]
    heavy.append((images, "a pipe", no_file(images, "pipe"), "a pipe"))
    yield from met(write_model, heavy, alone=True)
    gone = (MODEL, "no model", all_of(*map(remove, PARTS)), "holds no COLMAP model")
    yield from met(write_model, [gone], plan=True)

    as_text: list[Case] = [("images", "missing", remove("images"), "is missing")]
    for row, word in (("nonsense", NO_MODEL), ("1 PINHOLE 8 6 10", NO_CAMERA),
                      ("1 MAGIC 8 6 10 10 4 3", "MAGIC is not supported"),
                      (f"1 PINHOLE {'9' * 5000} 6 10 10 4 3", NO_MODEL)):  # fmt: skip
        as_text.append((f"{MODEL}/cameras.txt", row[:24], f"{row}\n", word))
    kept = "1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 1 0 0 1 b.png\n\n"
    for row, word in (("3 nan 0 0 0 2 0 0 1 c.png", NO_POSE),
                      ("3 1 0 0 0 2 0 0 1", "line 5 is neither"),
                      ("3 1 0 0 0 2 0 0 1 c.png\n4 5 -1 6 7 -1 8", "line 6 is neither"),
                      ("3 1 0 0 0 2 0 0 1 c.png\n4 5 -1 6 7 -1 8 9 -1 4",
                       "line 6 is neither")):  # fmt: skip
        as_text.append((f"{MODEL}/images.txt", row, f"{kept}{row}\n", word))
    as_text.append(
        (f"{MODEL}/points3D.txt", "half a track", "1 0 0 2 9 9 9 .5 1 0 2\n", "a point of 11 words")
    )
    as_text.append(
        (f"{MODEL}/cameras.txt", "half a pixel", "1 PINHOLE 8.5 6 10 10 4 3\n", "no whole number")
    )
    as_text += [("scene.json", f"test_every = {value!r}", keys("scene.json", test_every=value),
                 "test_every")
                for value in (True, 0, "8")]  # fmt: skip
    as_text += [("scene.json", f"frames = {value!r}",
                 keys("scene.json", test_every=8, frames=value), "frames")
                for value in (3, [{"file": 3}])]  # fmt: skip
    as_text += [("scene.json", f"labels = {value!r}", keys("scene.json", labels=value), "label")
                for value in ([], {"7": " "}, {"7": ["sofa"]})]  # fmt: skip
    as_text += [("labels.json", f"an id of {key[:9]!r}", f'{{"{key}": "sofa"}}',
                 "a label's id is not usable")
                for key in ("-1", "65536", "9" * 5000)]  # fmt: skip
    yield from met(write_colmap, as_text)


# transforms.json

FILE = "transforms.json"
NO_NUMBERS, ELSEWHERE, RIGID, FAR = (
    "no numbers",
    "lies elsewhere",
    "is not a rotation",
    ("units from the origin"),
)


def frame(**values: Any) -> Edit:
    """The second of three frames, changed."""
    return changed(FILE, lambda document: document["frames"][1].update(values))


def frames(change: Callable[[Any], Any]) -> Edit:
    """All frames, changed."""
    return changed(FILE, lambda d: d | {"frames": [f | change(f) for f in d["frames"]]})


def by_angle(text: str) -> Edit:
    """The angle as it is written, which JSON might not be able to say."""

    def edit(source: Path) -> None:
        document = json.loads((source / FILE).read_text())
        del document["fl_x"]
        put(FILE, json.dumps(document)[:-1] + f', "camera_angle_x": {text}}}')(source)

    return edit


def moved(value: float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[0, 3] = value
    return matrix.tolist()


def transforms() -> Iterator[Row]:
    cases: list[Case] = [
        (FILE, "half an object", '{"frames": [', "does not parse"),
        (FILE, "a list", "[]", "holds a list"),
        (FILE, "nested lists", DEEP, "nested too deeply"),
    ]
    cases += [
        (FILE, f"frames = {value}", keys(FILE, frames=value), "no frames")
        for value in (None, [], "a")
    ]
    cases += [
        (FILE, f"frames = {value}", keys(FILE, frames=value), "a frame") for value in ([3], [{}])
    ]
    for what, matrix, word in (
        ("null", None, "does not hold numbers"),
        ("3 columns", np.eye(3).tolist(), "is (3, 3)"),
        ("ragged", [[1], [1, 2]], "no usable transform_matrix"),
        ("words", [["1", "0", "0", "0"]] * 4, "does not hold numbers"),
        ("twice the size", (2 * np.eye(4)).tolist(), RIGID),
        ("mirrored", np.diag([1.0, 1, -1, 1]).tolist(), RIGID),
        ("another last row", np.diag([1.0, 1, 1, 2]).tolist(), RIGID),
        ("1e7 away", moved(1e7), FAR),
    ):
        cases.append((FILE, f"a matrix: {what}", frame(transform_matrix=matrix), word))
    numbers: dict[str, dict[str, tuple[Any, ...]]] = {
        NO_NUMBERS: {"fl_x": (NAN, "10", True, 10**400), "w": (None,), "k1": ("0.1",)},
        NO_CAMERA: {"fl_x": (0, 1e300), "cx": (1e30,), "w": (0,), "h": (2**63,), "k1": (1e30,)},
        "is not supported": {"k4": (0.1,), "camera_model": ("EQUIRECTANGULAR", {})},
    }
    cases += [(FILE, f"{key} = {json.dumps(value)[:20]}", keys(FILE, **{key: value}), word)
              for word, given in numbers.items()
              for key, values in given.items() for value in values]  # fmt: skip
    cases += [
        (FILE, f"camera_angle_x = {text}", by_angle(text), NO_NUMBERS)
        for text in ("0", "1e400", "3.2")
    ]
    paths = {"climbs": "../../etc/hostname", "is absolute": "/etc/x.png",
             "climbs late": "images/../../x.png",
             "climbs by backslashes": "..\\..\\x.png"}  # fmt: skip
    cases += [
        (FILE, f"a path that {what}", frame(file_path=path), ELSEWHERE)
        for what, path in paths.items()
    ]
    cases += [
        (FILE, "a path that is a list", frame(file_path=["a.png"]), "no object with paths as text"),
        (FILE, "mask_path climbs out", frame(mask_path="../../x.png"), ELSEWHERE),
        (
            FILE,
            "depth_file_path is a number",
            frame(depth_file_path=1),
            "no object with paths as text",
        ),
        (
            FILE,
            "no focal length",
            changed(FILE, lambda d: d.pop("fl_x") and None),
            "camera_angle_x",
        ),
        ("masks/x.png", "missing", frame(mask_path="masks/x.png"), "is missing"),
        ("images/frame_9.png", "another size than w", keys(FILE, w=9), "its camera 9x6"),
        (
            "images/frame_9.png",
            "listed twice",
            frame(file_path="images/frame_9.png"),
            "are both view frame_9",
        ),
    ]
    yield from met(write_transforms, cases)
    few: list[Case] = [
        (
            "ingest.min_views",
            "poses of inf",
            frames(lambda f: {"transform_matrix": [[INF] * 4] * 4}),
            "not finite",
        ),
        (
            "ingest.min_views",
            "no photo",
            frames(lambda f: {"file_path": f["file_path"] + "x"}),
            "3 listed frames",
        ),
    ]
    yield from met(write_transforms, few, 4)
    heavy: list[Case] = [
        (FILE, f"a {kind}", no_file(FILE, kind), "a device") for kind in ("pipe", "device")
    ]
    yield from met(
        write_transforms, [*heavy, (FILE, "a terabyte", swollen(FILE), "are read")], alone=True
    )
    climbs = (FILE, "a path climbs", frame(file_path="../x"), ELSEWHERE)
    yield from met(write_transforms, [(FILE, "nested lists", DEEP, "nested"), climbs], plan=True)


# Replica

POSE = "1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1\n"
TRAJECTORY, CAMERA, CLASSES = "traj.txt", "cam_params.json", "info_semantic.json"


write_slam = partial(layouts.write_nice_slam, fields=tiny())
write_nerf = partial(layouts.write_semantic_nerf, fields=tiny())


def replica() -> Iterator[Row]:
    two, lost = POSE.format(0) * 2, remove("results/frame000001.png")
    cases: list[Case] = [
        (TRAJECTORY, "a row too few", two, "2 poses for 3 images"),
        (TRAJECTORY, "words", "a\nb\nc\n", "row 1 does not hold 16 numbers"),
        (
            TRAJECTORY,
            "15 numbers",
            two + POSE[:-3].format(0) + "\n",
            "row 3 does not hold 16 numbers",
        ),
        (TRAJECTORY, "1e30 away", two + POSE.format(1e30), FAR),
        (
            TRAJECTORY,
            "twice the size",
            two + POSE.format(0).replace("1", "2"),
            "frame000002 is not a rotation",
        ),
        (TRAJECTORY, "missing", remove(TRAJECTORY), "is missing"),
        (TRAJECTORY, "a frame is missing", lost, "3 poses for 2 images"),
        (
            TRAJECTORY,
            "a frame and a row are missing",
            all_of(lost, put(TRAJECTORY, two)),
            "image 1 is missing",
        ),
        ("results/depth000001.png", "missing", remove("results/depth000001.png"), "is missing"),
        ("scene", "no results", remove("results"), "neither results/"),
        (CAMERA, "missing", remove(CAMERA), "is missing"),
        (CAMERA, "no camera", '{"camera": []}', "lacks a camera's"),
    ]
    values: dict[str, dict[str, tuple[Any, ...]]] = {
        NO_NUMBERS: {"w": ("8",), "fx": (NAN,)},
        NO_CAMERA: {"w": (0,), "fx": (-1,)},
        "lacks a camera's": {"cx": ("4",), "scale": (True, NAN)},
        "depth scale": {"scale": (0, 1e7)},
    }
    for word, given in values.items():
        for key, value in ((key, value) for key, each in given.items() for value in each):
            change = changed(
                CAMERA, lambda d, key=key, value=value: d["camera"].update({key: value})
            )
            cases.append((CAMERA, f"{key} = {value!r}", change, word))
    yield from met(write_slam, cases)
    nowhere = put(TRAJECTORY, POSE.format("nan") * 3)
    yield from met(write_slam, [("ingest.min_views", "poses of nan", nowhere, "not finite")], 4)
    yield from met(
        write_slam, [(TRAJECTORY, "a terabyte", swollen(TRAJECTORY), "are read")], alone=True
    )
    cases = [(CLASSES, text, text, "lacks classes with id and name")
             for text in ("{}", '{"classes": 3}', '{"classes": ["a"]}')]  # fmt: skip
    for value in (-1, True, 70_000):
        entry = {"id": value, "name": "a"}
        cases.append(
            (
                CLASSES,
                f"an id of {value}",
                keys(CLASSES, classes=[entry]),
                "a label's id is not usable",
            )
        )
    cases.append(
        (CLASSES, "no name", keys(CLASSES, classes=[{"id": 1, "name": ""}]), "label 1 has ''")
    )
    for name in ("traj_w_c.txt", "depth/depth_2.png"):
        cases.append((f"Sequence_1/{name}", "missing", remove(f"Sequence_1/{name}"), "is missing"))
    yield from met(write_nerf, cases)
    strangers = keys(CLASSES, classes=[{"id": 9, "name": "wall"}])
    yield from met(
        write_nerf, [("ids [0, 1, 2]", "no label has a name", strangers, "no label has a name")], 4
    )


# ScanNet and 7-Scenes

EYE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
TABLE, POINTS, SPLIT = "scannetv2-labels.modified.tsv", "points3d.ply", "splits.json"
CONFIDENCE = "m2f_probabilities/20.npz"
HEAD, IDS = (
    "id\traw_category\tcocomapid\n",
    ("ids must not be negative, and values of cocomapid must lie in 0...20"),
)
SURE = np.ones((6, 8), np.float32)
NO_PLY, COPY, LISTS = (
    "is not a readable PLY",
    "copy it again",
    ("lacks lists of train and test names"),
)


def header(
    n: object = 20, form: str = "binary_little_endian 1.0", axes: str = "xyz", more: str = ""
) -> bytes:
    rows = "".join(f"property float {axis}\n" for axis in axes)
    return f"ply\nformat {form}\nelement vertex {n}\n{rows}{more}end_header\n".encode()


def coordinates(last: float = 0.0, n: int = 20) -> bytes:
    rows = np.arange(3 * n, dtype="<f4").reshape(n, 3)
    rows[-1, 0] = last
    return rows.tobytes()


ROOM = tiny(4, (20, 16))
write_sg = partial(layouts.write_scannet_sg, fields=ROOM)
TAUGHT = ROOM | {"pseudo_labels": ROOM["labels"], "confidence": np.ones((4, 16, 20))}
write_pl = partial(layouts.write_scannet_pl, fields=TAUGHT)
write_seven_scenes = partial(layouts.write_seven_scenes, fields=tiny())


def scannet() -> Iterator[Row]:
    pose, intrinsics = "pose/20.txt", "intrinsic/intrinsic_color.txt"
    faces = "element face 1\nproperty list uint int vertex_index\n"
    lists = header().replace(b"property float x", b"property list uint float x")
    clouds: list[tuple[str, bytes, str]] = [
        ("empty", b"", NO_PLY),
        ("a header without an end", header()[:-11], NO_PLY),
        ("cut in a row", header() + coordinates()[:-5], NO_PLY),
        ("two x", header(axes="xxyz") + coordinates() * 2, NO_PLY),
        ("lists for x", lists + b"\xff" * 400, NO_PLY),
        ("words", header(2, "ascii 1.0") + b"a b c\nd e f\n", NO_PLY),
        ("too few rows of text", header(9, "ascii 1.0") + b"0 0 0\n" * 5, NO_PLY),
        (
            "a face of 2^32 corners",
            header(more=faces) + coordinates() + struct.pack("<I", 2**32 - 1),
            NO_PLY,
        ),
        ("no z", header(axes="xy") + coordinates(), "has no x, y, z"),
        ("0 points", header(0), "holds 0 points"),
        ("nan", header() + coordinates(NAN), "not finite"),
    ]
    tables = [("nothing", "", IDS), ("a negative id", f"{HEAD}-1\twall\t1\n", IDS),
              ("class 21", f"{HEAD}1\twall\t21\n", IDS),
              ("short rows", f"{HEAD}1\n", "no usable columns"),
              ("another column", "id\tnyu40id\n1\t1\n", "cocomapid"),
              ("an endless id", f"{HEAD}{'9' * 5000}\twall\t1\n", "no usable columns"),
              ("an open quote", f'{HEAD}1\t"{"a" * 200_000}', "is no table")]  # fmt: skip
    cases: list[Case] = [
        (pose, "nothing", "", "3x3 or 4x4 matrix"),
        (pose, "words", "camera to world\n", "does not hold numbers"),
        (pose, "a ragged row", EYE.replace("0 0 1 0", "0 0 1"), "3x3 or 4x4 matrix"),
        ("20", "a scale", put(pose, EYE.replace("1", "2")), RIGID),
        ("20", "1e30 away", put(pose, EYE.replace("1 0 0 0", "1 0 0 1e30")), FAR),
        (intrinsics, "cx = 1e30", "10 0 1e30\n0 10 3\n0 0 1\n", "principal point at 1e+30"),
        *((POINTS, what, content, word) for what, content, word in clouds),
        *((TABLE, what, text, word) for what, text, word in tables),
        *((place, "missing", remove(place), "is missing")
          for place in (pose, intrinsics, TABLE)),
    ]  # fmt: skip
    yield from met(write_sg, cases)
    bombs = {"10^12 points": header(10**12) + coordinates(),
             "10^12 points as text": header(10**12, "ascii 1.0"),
             "a long header": header(more="comment a\n" * 200_000) + coordinates(),
             "2,000 values a point": header(10**5, more="property double p\n" * 2000)
             + bytes(1 << 18)}  # fmt: skip
    heavy: list[Case] = [(POINTS, what, content, NO_PLY) for what, content in bombs.items()]
    heavy += [
        (POINTS, "a pipe", no_file(POINTS, "pipe"), "a pipe"),
        (TABLE, "a terabyte", swollen(TABLE), "are read"),
    ]
    yield from met(write_sg, heavy, alone=True)

    cases = [
        (SPLIT, f"test = {value!r}", keys(SPLIT, test=value), LISTS)
        for value in (None, "30", {"30": 1}, [30])
    ]
    cases.append(
        (SPLIT, "a view in both lists", keys(SPLIT, train=["10"], test=["10"]), "10 is both")
    )
    cases.append((CONFIDENCE, "missing", remove(CONFIDENCE), "is missing"))
    cases.append((CONFIDENCE, "cut short", cut(CONFIDENCE, 40), COPY))
    for what, content in {
        "no zip": b"confidence", "another name": npz(probability=npy(SURE)),
        "one row": npz(confidence=npy(SURE[0])),
        "words": npz(confidence=npy(np.full((6, 8), "a"))), "nan": npz(confidence=npy(SURE * NAN)),
        "objects": npz(confidence=npy(np.zeros((6, 8)), descr="|O")),
        "no pixel": npz(confidence=npy(SURE[:0])),
        "7": npz(confidence=npy(7 * SURE)),
    }.items():  # fmt: skip
        cases.append((CONFIDENCE, what, content, COPY))
    yield from met(write_pl, cases)
    heavy = [(CONFIDENCE, "terabytes", npz(confidence=npy(SURE, shape=(10**6, 10**6))), COPY),
             (CONFIDENCE, "18 MB of zeros", npz(confidence=npy(np.zeros((1500, 1500)))), COPY),
             (CONFIDENCE, "a pipe", no_file(CONFIDENCE, "pipe"), "a pipe")]  # fmt: skip
    yield from met(write_pl, heavy, alone=True)
    strangers = keys(SPLIT, train=["x"], test=["y"])
    yield from met(
        write_pl, [("ingest.min_views", "a split of strangers", strangers, "splits.json")], 4
    )


def seven_scenes() -> Iterator[Row]:
    pose, color, depth = (f"frame-000001.{end}" for end in ("pose.txt", "color.png", "depth.png"))
    intrinsics = "camera-intrinsics.txt"
    yield from met(write_seven_scenes, [
        (pose, "half a matrix", "1 0 0 0\n0 1 0 0\n", "3x3 or 4x4 matrix"),
        (pose, "a mirror", EYE.replace("0 0 1 0", "0 0 -1 0"), RIGID),
        (pose, "missing", remove(pose), "is missing"),
        (intrinsics, "f = -10", "-10 0 4\n0 10 3\n0 0 1\n", "focal length"),
        (intrinsics, "f = nan", "nan 0 4\n0 10 3\n0 0 1\n", "no numbers"),
        (color, "cut short", cut(color, 30), BROKEN),
        (color, "another size", picture(color, (16, 9)), "its camera 8x6"),
        (depth, "missing", remove(depth), "is missing"),
        (depth, "another size", picture(depth, (4, 4), "I;16"), "its photo 8x6"),
        ("frame-000001", "two pictures", picture("frame-000001.color.jpg", form="JPEG"),
         "are both view"),
    ])  # fmt: skip


# what writes each folder, its layout, and how many views it has
WHOLE: dict[str, tuple[Callable[[Path], Any], str, int]] = {
    "photos": (write_photos, "photos", 3),
    "companions": (write_companions, "colmap", 3),
    "COLMAP": (write_model, "colmap", 3),
    "COLMAP as text": (write_colmap, "colmap", 3),
    "transforms": (write_transforms, "transforms", 3),
    "NICE-SLAM": (write_slam, "replica", 3),
    "Semantic-NeRF": (write_nerf, "replica", 3),
    "ScanNet (SG)": (write_sg, "scannet", 4),
    "ScanNet (PL)": (write_pl, "scannet", 4),
    "7-Scenes": (write_seven_scenes, "seven_scenes", 3),
}


def rows() -> Iterator[Row]:
    for part in (photos, companions, colmap, transforms, replica, scannet, seven_scenes):
        yield from part()
