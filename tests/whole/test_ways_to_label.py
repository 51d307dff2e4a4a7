"""One scene's labels written in many ways: its mIoU is what they are worth, or a line names what
was in the way.
"""

import json
import logging
import re

import numpy as np
import pytest
from label_maps import arrays, masks, pictures
from shared import run_stage

from chebsplat.errors import ChebsplatError
from chebsplat.formats.evaluation import Evaluation
from chebsplat.synthetic import CLASS_NAMES
from tests.whole.test_ways_to_write import CONFIG, colmap, scene

NAMES = list(CLASS_NAMES)
POINTS = 0.5  # of mIoU, that a way to write labels may be off without a word
LABELLED = CONFIG | {
    "teacher": {"kind": "labels", "confusion": 0.3},
    "train": CONFIG["train"] | {"semantics": True},
    "evaluate": {"timing_repeats": 0},
}
__all__ = ["scene"]  # the fixture


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    """A scene that was trained from labels by name, and what it says of the test views, names [2,
    H, W].
    """
    folder = tmp_path_factory.mktemp("made")
    write(folder / "scene", scene, pictures(IDS))
    inputs = {}
    given = {
        "ingest": (), "sfm": ("capture",), "teacher": ("capture",),
        "train": ("capture", "points", "features"),
        "export": ("gaussians", "features"), "evaluate": ("capture", "scene", "features"),
    }  # fmt: skip
    of = {
        "capture": "ingest",
        "points": "sfm",
        "features": "teacher",
        "gaussians": "train",
        "scene": "export",
    }
    for stage, roles in given.items():
        inputs[stage] = folder / stage
        assert (
            run_stage(
                stage, inputs[stage], {role: inputs[of[role]] for role in roles}, config(folder)
            )
            == 0
        )
    found = Evaluation.read(inputs["evaluate"])
    classes = found.figures["segmentation"]["classes"]
    said = np.array([*classes, None], object)[found.pictures["predicted"][:]]
    worth = found.figures["segmentation"]["scene"]["miou"]
    assert miou(said, truth_of(scene, (), range(16)), ()) == pytest.approx(100 * worth)
    assert worth > 0.5
    return inputs["export"], said


def config(folder):
    return LABELLED | {"source": {"kind": "colmap", "path": str(folder / "scene")}}


def truth_of(scene, lost, views):
    """Names of the test views' classes [2, H, W], None where there are none, of lost classes, and
    in other views.
    """
    names = np.array([*(None if name in lost else name for name in NAMES), None], object)
    return np.stack(
        [names[scene["labels"][k] if k in views else np.full((72, 96), -1)] for k in (0, 8)]
    )


def miou(said, truth, lost):
    """Oracle: mean over names of |both| / |either| of their pixels where there is a truth, in per
    cent; of no class None.
    """
    known = truth != None  # noqa: E711
    pairs = [((said == name) & known, truth == name) for name in NAMES if name not in lost]
    ious = [(a & b).sum() / (a | b).sum() for a, b in pairs if (a | b).any()]
    return 100 * float(np.mean(ious)) if ious else None


IDS = [*range(1, len(NAMES) + 1), 0]
ZERO = [*range(len(NAMES)), 255]
COLORS = np.random.default_rng(4).integers(1, 256, (len(NAMES) + 1, 3)).astype(np.uint8)
COLORS[-1] = 0
HEX = {"#" + bytes(color).hex(): name for color, name in zip(COLORS, NAMES, strict=False)}
SCORES = 0.1 + np.eye(len(NAMES) + 1, len(NAMES))


def write(folder, scene, of_map, names=None, place="semantic", views=range(16), half=False):
    """A COLMAP source whose maps `of_map` writes; names by id, or all from 1; "": no
    labels.json.
    """
    colmap(folder, scene, depth=lambda z: 1000 * z)
    (folder / place).mkdir()
    for k in views:
        of_map(folder / place / scene["names"][k], scene["labels"][k][:: 1 + half, :: 1 + half])
    listed = dict(enumerate(NAMES, 1)) if names is None else names
    if listed != "":
        (folder / "labels.json").write_text(json.dumps(listed))


def renamed(change, **others):
    return {k: others.get(name, change(name)) for k, name in enumerate(NAMES, 1)}


def ids(**how):
    return {"of_map": pictures(IDS)} | how


UNMATCHED = "no label of the scene is called like"
# what: (how it is written, classes that do not count, a word of the line that names the cause where
# mIoU is another or none)
WAYS = {
    "8 bits": (ids(), (), ""),
    "JPEG": ({"of_map": pictures(IDS, ending=".jpg", form="JPEG")}, (), "is a JPEG picture"),
    "arrays": ({"of_map": arrays(IDS)}, (), ""),
    "arrays turned": ({"of_map": arrays(IDS, axes=(1, 0))}, (), "its photo 96x72"),
    "half as large": (ids(half=True), (), ""),
    "segmentation/": (ids(place="segmentation"), (), ""),
    "capitals": (ids(names=renamed(str.upper)), (), ""),
    "names in other words": (ids(names=renamed("mi {}".format)), (), UNMATCHED),
    "one name in other words": (ids(names=renamed(str, wall="zyx")), (), f"{UNMATCHED}.*: zyx"),
    "a class that is unannotated": (ids(names=renamed(str, wall="unannotated")), ("wall",), ""),
    "a class that is void": (ids(names=renamed(str, wall=" Void")), ("wall",), ""),
    "a class without a name": (ids(names=dict(list(enumerate(NAMES, 1))[1:])), (NAMES[0],), ""),
    "a class alone": (ids(names={1: NAMES[0]}), NAMES[1:], "one class alone"),
    "background of id 0": (ids(names=renamed(str) | {0: "background"}), (), ""),
    "from 0 with 255, with names": (
        {"of_map": pictures(ZERO), "names": dict(enumerate(NAMES))},
        (),
        "",
    ),
    "from 0 with 255, without names": ({"of_map": pictures(ZERO), "names": ""}, (), UNMATCHED),
    "ids without names": (ids(names=""), (), "have no names"),
    "colours": ({"of_map": pictures(COLORS), "names": HEX}, (), ""),
    "colours without names": (
        {"of_map": pictures(COLORS), "names": ""},
        (),
        "colours without names",
    ),
    "scores": (
        {"of_map": arrays(SCORES, np.float32, (2, 0, 1)), "names": dict(enumerate(NAMES))},
        (),
        "",
    ),
    "masks": ({"of_map": masks(NAMES), "names": ""}, (), ""),
    "test views alone": (ids(views=(0, 8)), (), ""),
    "one test view": (ids(views=range(8)), (), ""),
    "no test view": (ids(views=range(1, 8)), (), "no pixel of the evaluated views"),
    "ids by name": (
        ids(names={name: k for k, name in enumerate(NAMES, 1)}),
        (),
        "id is not usable",
    ),
}


@pytest.mark.slow
@pytest.mark.xdist_group("ways to label")
@pytest.mark.parametrize("way", WAYS)
def test_a_way_to_write_labels_is_worth_what_they_are_or_a_line_says_why(
    scene, made, tmp_path, caplog, capfd, way
):
    (how, lost, word), (exported, said) = WAYS[way], made
    worth = miou(said, truth_of(scene, lost, how.get("views", range(16))), lost)
    write(tmp_path / "scene", scene, **how)
    found, told = None, ""
    with caplog.at_level(logging.INFO, "chebsplat"):
        try:
            if run_stage("ingest", tmp_path / "ingest", {}, config(tmp_path)) == 0:
                given = {"capture": tmp_path / "ingest", "scene": exported}
                assert run_stage("evaluate", tmp_path / "evaluate", given, config(tmp_path)) == 0
                found = Evaluation.read(tmp_path / "evaluate").figures["segmentation"]["scene"][
                    "miou"
                ]
        except ChebsplatError as refused:
            told = str(refused)
    told += caplog.text + capfd.readouterr().err
    found = None if found is None else 100 * found
    print(f"{way}: {found} of {worth} %")
    if found is None or worth is None or abs(found - worth) > POINTS:
        assert word and re.search(word, told, re.IGNORECASE), (
            f"{found} % of {worth}: {told[-2000:]}"
        )
