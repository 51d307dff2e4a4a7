"""Label maps, whatever they are written as: each pixel's class is the one that was written, and a
line says so.
"""

import json
import re
import shutil

import layouts
import numpy as np
import pytest
from label_maps import arrays, masks, pictures
from PIL import Image
from source_folders import save, tiny

from chebsplat.errors import DataFailure, InputError
from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import colmap, labels, scannet, transforms
from chebsplat.stages.sources.common import Listing

SETTINGS = IngestSection(min_views=2)
NAMES = ["wall", "floor", "tv screen"]
# the last: of no class
RGB = np.array([[255, 0, 0], [0, 200, 0], [7, 7, 200], [0, 0, 0]], np.uint8)
CLASS = np.random.default_rng(0).integers(-1, 3, (3, 6, 8))
CLASS[:, 0, :4] = [-1, 0, 1, 2]


def source(folder, write, names=None, classes=CLASS, inner=""):
    """Three views whose maps `write(path without an ending, class [6, 8])` writes; names of
    labels.json; `inner`: the folder of the photos in images/.
    """
    fields = tiny() | {
        "names": [f"{inner}{name}" for name in "abc"],
        "labels": np.zeros((3, 6, 8), np.int16),
    }
    layouts.write_colmap(folder, fields)
    shutil.rmtree(folder / "semantic")
    (folder / "semantic").mkdir()
    (folder / "labels.json").unlink()
    for name, of_view in zip("abc", classes, strict=True):
        write(folder / "semantic" / name, of_view)
    if names is not None:
        (folder / "labels.json").write_text(json.dumps(names))
    return folder


def palette(path, of_view):
    image = Image.fromarray((of_view + 1).astype(np.uint8))
    image.putpalette([0, 0, 0, 200, 0, 0, 0, 200, 0, 0, 0, 200])
    image.save(path.with_suffix(".png"))


BY_ID = {"1": "wall", "2": "floor", "3": "tv screen"}
ONE, ZERO, CODE = [1, 2, 3, 0], [0, 1, 2, 255], [0, 1, 2, 65_535]
UNNAMED = ["class_0", "class_1", "class_2"]
GREY, CLEAR = np.stack([ONE] * 3, -1), np.concatenate([RGB, [[255]] * 3 + [[0]]], 1)
HEX = ["#ff0000", "#00c800", "#0707c8"]
SCORES, FIRST, BY_PLACE = np.eye(4, 3), (2, 0, 1), dict(enumerate(NAMES))
# what: (writer, labels.json, the classes that are found in the order of NAMES, what is said)
WAYS = {
    "ids with names": (pictures(ONE), BY_ID, NAMES, "taken for ids with names: 3 classes"),
    "16 bits": (pictures(ONE, np.uint16), BY_ID, NAMES, "taken for ids with names"),
    "a palette": (palette, BY_ID, NAMES, "taken for ids with names"),
    "an ending in capitals": (pictures(ONE, ending=".PNG"), BY_ID, NAMES,
                              "taken for ids with names"),
    "a PNG called .jpg": (pictures(ONE, ending=".jpg"), BY_ID, NAMES, "taken for ids with names"),
    "an array": (arrays(ONE, np.uint8), BY_ID, NAMES, "taken for ids with names"),
    "an array of floats": (arrays(ONE, np.float32), BY_ID, NAMES, "taken for ids with names"),
    "an array with -1": (arrays([0, 1, 2, -1]), BY_PLACE, NAMES, "with names"),
    "names spelt in two ways": (pictures([1, 2, 3, 9]), BY_ID | {"9": " VOID "}, NAMES,
                                "called VOID are void"),
    "ids without names": (pictures(ONE), None, ["class_1", "class_2", "class_3"],
                          r"no names.*; 0 \(\d.*none of"),
    "255 for void": (pictures(ZERO), None, UNNAMED,
                     r"255 \(\d.* is taken for void, and 0 for a class"),
    "65535 for void": (pictures(CODE, np.uint16), None, UNNAMED,
                       r"65535 \(\d.* is taken for void, and 0 for a class"),
    "255 without a name": (pictures(ZERO), BY_PLACE, NAMES,
                           r"without a name are ignored: 255 \(\d"),
    "colours": (pictures(RGB), None, HEX, r"taken for colours without names.*#000000 \(\d"),
    "colours with names": (pictures(RGB), dict(zip(HEX, NAMES, strict=True)), NAMES,
                           "taken for colours with names"),
    "transparent colours": (pictures(CLEAR), None, HEX, "taken for colours without names"),
    "grey colours": (pictures(GREY), BY_ID, NAMES, "taken for ids with names"),
    "scores, classes last": (arrays(SCORES, np.float32), BY_PLACE, NAMES,
                             "taken for scores by class with names"),
    "scores, classes first": (arrays(SCORES, np.float32, FIRST), None, UNNAMED,
                              "scores by class without names"),
    "one-hot": (arrays(SCORES, bool, FIRST), BY_PLACE, NAMES, "taken for scores by class"),
    "masks of a view": (masks(NAMES), None, NAMES, "taken for one mask a class"),
    "masks of a view as JPEG": (masks(NAMES, "jpg"), None, NAMES, "taken for one mask a class"),
    "masks of a class": (masks(NAMES, swapped=True), None, NAMES, "taken for one mask a class"),
}  # fmt: skip


def check(fields, names, wanted=CLASS):
    """Every pixel has the class that was written."""
    by_name = np.array([*fields["class_names"], None], object)[fields["labels"]]
    assert (by_name == np.array([*names, None], object)[wanted]).all()


def said(fields):
    return " ".join([fields["source"]["labels"], *fields["source"]["notes"]])


@pytest.mark.parametrize("way", WAYS)
def test_a_pixel_s_class_is_the_one_that_was_written_and_a_line_says_what_maps_were_taken_for(
    tmp_path, way
):
    write, names, found, word = WAYS[way]
    fields = colmap.read(source(tmp_path, write, names), SETTINGS)
    check(fields, found)
    assert re.search(word, said(fields)), said(fields)
    assert colmap.probe(tmp_path)["labels"]
    listed = set(colmap.files(tmp_path))
    assert {path for path in (tmp_path / "semantic").rglob("*") if path.is_file()} <= listed


@pytest.mark.parametrize("inner", ["", "left/"])
@pytest.mark.parametrize("shown", [("0", "0", "0"), ("0", "1", "2"), ("012", "0", "1")])
def test_masks_in_folders_of_classes_are_told_from_ids_whatever_classes_a_view_shows(
    tmp_path, shown, inner
):
    wanted = [
        np.where(np.isin(of_view, [*map(int, of)]), of_view, -1)
        for of_view, of in zip(CLASS, shown, strict=True)
    ]
    fields = colmap.read(
        source(tmp_path, masks(NAMES, swapped=True), classes=wanted, inner=inner), SETTINGS
    )
    check(fields, NAMES, np.array(wanted))
    assert "taken for one mask a class" in said(fields)


@pytest.mark.parametrize(
    ("present", "code"),
    [([0, 1, 2, 255], 255), ([0, 1, 65_535], 65_535), ([1, 2, 4, 5, 255], 255),
     ([0, 2, 3, 40, 255], None),
     ([0, 255], None), ([0, 51, 102, 153, 204, 255], None), (list(range(256)), None),
     ([0, 1, 2], None),
     ([0, 1, 2, 254, 255], None), ([255], None), ([], None), ([0, 1, 255, 65_535], None)],
)  # fmt: skip
def test_which_of_ids_without_names_is_void(present, code):
    assert labels.void_code(present) == code


@pytest.mark.parametrize(
    ("name", "which", "void"),
    [(name, 5, True) for name in ("unannotated", "Unlabeled", "unlabelled", "ignore", "IGNORED ",
                                  "void", "un-defined",
                                  "none", "No Label", "not_labeled", "unknown")]
    + [("background", 0, True), ("Background", 255, True), ("background", 7, False),
       ("#background", 255, False)]
    + [(name, 0, False) for name in ("other", "others", "otherprop", "otherfurniture", "clutter",
                                     "wall", "void deck")],
)  # fmt: skip
def test_names_of_the_usual_sets_that_mean_nothing_are_void_and_classes_are_not(name, which, void):
    kind, name = (labels.COLORS, name[1:]) if name[0] == "#" else (labels.IDS, name)
    raw = np.array([[[which, which, which, 999]]], np.int32)
    found, classes, notes = labels.indexed(raw, {which: name, 999: "sofa"}, None, kind)
    assert classes == (["sofa"] if void else [name, "sofa"])
    assert found.tolist() == ([[[-1, -1, -1, 0]]] if void else [[[0, 0, 0, 1]]])
    assert void == any(f"{which} (75.0% of the pixels)" in note for note in notes)


@pytest.mark.parametrize("place", ["semantics", "label", "labels", "segmentation"])
@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_maps_lie_in_folders_of_other_names_and_beside_a_transforms_json(tmp_path, place, kind):
    folder = source(tmp_path, pictures(ONE), BY_ID)
    (folder / "semantic").rename(folder / place)
    if kind == "transforms":
        frames = [
            {"file_path": f"images/{name}.png", "transform_matrix": np.eye(4).tolist()}
            for name in "abc"
        ]
        (folder / "transforms.json").write_text(json.dumps({"fl_x": 10.0, "frames": frames}))
    module = {"colmap": colmap, "transforms": transforms}[kind]
    assert module.probe(folder)["labels"] and folder / place / "a.png" in module.files(folder)
    check(module.read(folder, SETTINGS), NAMES)


@pytest.mark.parametrize("place", ["", "left/", "Left/"])
def test_maps_lie_in_the_folders_of_their_photos_or_in_fewer(tmp_path, place):
    folder = source(tmp_path, lambda path,
                    classes: pictures(ONE)(path.parent / place / path.name, classes), BY_ID,
                    inner="left/")  # fmt: skip
    check(colmap.read(folder, SETTINGS), NAMES)


def test_views_without_a_map_are_unknown_and_counted(tmp_path):
    folder = source(tmp_path, pictures(ONE), BY_ID)
    (folder / "semantic/b.png").unlink()
    fields = colmap.read(folder, SETTINGS)
    check(fields, NAMES, np.where(np.arange(3)[:, None, None] == 1, -1, CLASS))
    assert "2 of 3 views have labels; the others count as unknown." in said(fields)


def test_maps_of_another_kind_are_named_and_not_passed_over(tmp_path):
    folder = source(tmp_path, pictures(ONE), BY_ID)
    for path in (folder / "semantic").iterdir():
        path.rename(path.with_suffix(".tif"))
    (folder / "labels").mkdir()
    fields = colmap.read(folder, SETTINGS)
    assert "labels" not in fields
    of_labels = [note for note in fields["source"]["notes"] if "holds no PNG" in note]
    assert of_labels == ["semantic/ holds no PNG or .npy: not read (a.tif, b.tif, c.tif)."]


def test_a_name_given_twice_in_other_letters_is_one_class(tmp_path):
    fields = colmap.read(source(tmp_path, pictures(ONE), BY_ID | {"2": "Wall_"}), SETTINGS)
    assert len(fields["class_names"]) == 2
    assert np.array_equal(fields["labels"] == 0, (CLASS == 0) | (CLASS == 1))


def test_a_lossy_map_and_a_picture_of_many_colours_are_refused(tmp_path):
    folder = source(tmp_path, pictures(ONE), BY_ID)
    Image.fromarray(CLASS[1].astype(np.uint8)).save(
        folder / "semantic/b.png", format="JPEG", quality=100
    )
    with pytest.raises(
        InputError,
        match=r"semantic/b\.png is a JPEG picture.*write label maps as "
        r"PNG",
    ):
        colmap.read(folder, SETTINGS)
    listing = Listing("colmap", [], label_place="semantic", label_kinds={"a": labels.COLORS})
    with pytest.raises(InputError, match="holds 2000 colours"):
        labels.resolved(listing, np.arange(2000).reshape(1, 40, 50) * 999)


def test_colours_that_no_name_fits_are_an_error(tmp_path):
    with pytest.raises(DataFailure, match=r"no label has a name \(colours \[#000000, #00c800"):
        colmap.read(source(tmp_path, pictures(RGB), BY_ID), SETTINGS)


# ScanNet as its own tools export it

OWN_NAMES = ["wall", "floor", "television"]
OWN_IDS, NYU_IDS = [*(layouts.SCANNET_IDS[name] for name in OWN_NAMES), 0], [1, 2, 25, 0]
UNTOLD = ["class_1", "class_2", "class_25"]


@pytest.mark.parametrize(
    ("write", "beside", "found", "kind"),
    [
        (pictures(OWN_IDS, np.uint16), "SG's table", OWN_NAMES, "ids with names"),
        (pictures(OWN_IDS, np.uint16), "ScanNet's table", OWN_NAMES, "ids with names"),
        (pictures(NYU_IDS), "ScanNet's table", OWN_NAMES, "ids with names"),
        (pictures(NYU_IDS), "names", NAMES, "ids with names"),
        (pictures(NYU_IDS, np.uint16), "names", NAMES, "ids with names"),
        (pictures(RGB), "ScanNet's table", HEX, "colours without names"),
        (arrays(NYU_IDS), "ScanNet's table", UNTOLD, "ids without names"),
        (masks(NAMES), "ScanNet's table", NAMES, "one mask a class"),
    ],
)
@pytest.mark.parametrize("place", ["label", "semantics"])
def test_scannets_own_export_needs_no_points_and_its_label_folder_is_read(
    tmp_path, write, beside, found, kind, place
):
    fields = tiny() | {"class_names": NAMES, "labels": CLASS}
    fields["Ks"][:, 0, 2] += 0.5  # as written, half of these few pixels
    layouts.write_scannet(tmp_path, fields)
    (tmp_path / place).mkdir()
    for k, of_view in enumerate(CLASS):
        write(tmp_path / f"{place}/{10 * k}", of_view)
        save(tmp_path / f"depth/{10 * k}.png", layouts.stored_depth(fields["depth"][k]))
    if beside == "SG's table":
        layouts.write_table(tmp_path / scannet.MODIFIED, "cocomapid", layouts.COCO_IDS)
    elif beside == "ScanNet's table":
        layouts.write_table(tmp_path / scannet.OWN, "nyu40id", layouts.NYU_IDS)
    else:
        (tmp_path / "labels.json").write_text(json.dumps(dict(zip(NYU_IDS, NAMES, strict=False))))
    got = scannet.read(tmp_path, SETTINGS)
    check(got, found)
    assert "points" not in got and "without points3d.ply" in said(got)
    assert f"Labels of {place}/ are taken for {kind}: 3 classes" in said(got)
    maps = {path for path in (tmp_path / place).rglob("*") if path.is_file()}
    assert scannet.probe(tmp_path)["labels"] and maps <= set(scannet.files(tmp_path))
