"""check-teacher names the usual mistakes from eight photos, and accuses no teacher that is
right.
"""

import json
import re

import numpy as np
import onnx
import pytest
from click.testing import CliRunner
from onnx import helper
from PIL import Image
from shared import data
from tiny_teachers import color_teacher, ending, write_model, write_settings

from chebsplat.errors import InputError
from chebsplat.pipelines.cli import main
from chebsplat.stages.tools.get_teacher import check

TRANSPOSED, SOFTMAX = ("Transpose", [], {"perm": [0, 1, 3, 2]}), ("Softmax", [], {"axis": 1})
BYTES = {"std": [1 / 255] * 3, "mean": [0.0] * 3}
WRONG_SCALE = {"mean": [123.675, 116.28, 103.53], "std": [0.229, 0.224, 0.225]}


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Eight pictures of blocks of any colours in a folder, one of them upright."""
    folder = tmp_path_factory.mktemp("photos")
    for k in range(8):
        blocks = np.random.default_rng(k).integers(40, 216, (6, 8, 3), np.uint8)
        picture = np.kron(blocks, np.ones((8, 8, 1), np.uint8))
        Image.fromarray(picture if k else picture.swapaxes(0, 1)).save(folder / f"{k}.png")
    return folder


def of_colors(folder, *nodes, **settings):
    """The tiny segmenter of three colours."""
    (folder / "classes.txt").write_text("red\ngreen\nblue\n")
    model = color_teacher(
        folder, weights=5 * np.eye(3), output="logits", labels="classes.txt", **settings
    )
    return ending(model, *nodes) if nodes else model


def of_rooms(folder, *nodes, **settings):
    """One of four classes, by a kernel of noise."""
    (folder / "classes.txt").write_text("wall\nfloor\nsofa\nlamp\n")
    kernel = np.random.default_rng(0).normal(size=(4, 3, 4, 4)).astype(np.float32)
    model, conv = (
        folder / "tiny.onnx",
        helper.make_node("Conv", ["image", "kernel"], ["features"], strides=[4, 4]),
    )
    write_model(model, [conv], constants={"kernel": kernel})
    write_settings(
        model, **({"output": "logits", "labels": "classes.txt", "size": [48, 48]} | settings)
    )
    return ending(model, *nodes) if nodes else model


@pytest.mark.parametrize("tiny", [of_colors, of_rooms])
def test_what_photos_tell_of_a_tiny_segmenter(tmp_path, photos, tiny):
    """Colours alone do not tell red from blue, nor what names mean: that is said."""
    found = dict(check(tiny(tmp_path), [photos]))
    assert found["scores"] == "logits" and found["layout"] == "as the photos"
    assert (
        found["names"].startswith("cannot be told") and "sure of everything" not in found["range"]
    )
    if tiny is of_colors:
        assert found["range"].startswith("cannot be told") and found["order"].startswith(
            "cannot be told"
        )
    assert dict(check(tiny(tmp_path, SOFTMAX), [photos]))["scores"].startswith(
        "softmax, told by its values"
    )
    assert dict(check(tiny(tmp_path, TRANSPOSED), [photos]))["layout"].startswith("transposed: ")
    assert dict(check(tiny(tmp_path, SOFTMAX, SOFTMAX), [photos]))["scores"].endswith("scaled down")
    assert re.match(
        "sure of everything, as a model of 0 to 1|.* tells more",
        dict(check(tiny(tmp_path, **BYTES), [photos]))["range"],
    )
    with pytest.raises(
        InputError,
        match=r"mean of colours in 0 to 255.* write mean = \[0.485, "
        r"0.456, 0.406\]",
    ):
        check(tiny(tmp_path, **WRONG_SCALE), [photos])
    model = tiny(tmp_path)
    (tmp_path / "classes.txt").write_text("background\n" + (tmp_path / "classes.txt").read_text())
    with pytest.raises(InputError, match=r"gives \d channels, .* names \d classes"):
        check(model, [photos])


def test_the_command_takes_photos_one_by_one_or_a_folder(tmp_path, photos):
    model = of_colors(tmp_path)
    one_by_one = [word for path in sorted(photos.iterdir()) for word in ("--photo", str(path))]
    told = [
        CliRunner().invoke(main, ["check-teacher", str(model), *of])
        for of in (one_by_one, ["--photo", str(photos)])
    ]
    assert [of.exit_code for of in told] == [0, 0]
    lines = [
        [line for line in of.stdout.splitlines() if not line.startswith("seconds")] for of in told
    ]
    assert lines[0] == lines[1] and any(
        line.startswith("layout   as the photos") for line in lines[0]
    )


MISTAKES = {  # nodes at the end, names moved by, TOML; the row of the finding, how it begins
    "none": ((), 0, {}, "range", "as given"),
    "0 to 255": ((), 0, BYTES, "range", "0 to 1 tells more"),
    "ImageNet's": (
        (),
        0,
        {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]},
        "range",
        "0 to 1 tells more",
    ),
    "-1 to 1": ((), 0, {"mean": [0.5] * 3, "std": [0.5] * 3}, "range", "0 to 1 tells more"),
    "BGR": ((), 0, {"order": "BGR"}, "order", "RGB is surer"),
    "softmax": ((SOFTMAX,), 0, {}, "scores", "softmax, told by its values"),
    "transposed": ((TRANSPOSED,), 0, {}, "layout", "transposed"),
    "a background too many": ((), 1, {}, "names", "one class off"),
    "a background too few": ((), -1, {}, "names", "one class off"),
}
RIGHT = {
    "scores": "logits",
    "layout": "as the photos",
    "range": "as given",
    "order": "RGB: ",
    "names": "make sense",
}


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_real_segmenter_s_mistake_is_named_and_nothing_else_is(tmp_path, mistake):
    nodes, moved, settings, row, begins = MISTAKES[mistake]
    graph = onnx.load(data("ade31_teacher") / "mosaic_r4.onnx")
    graph.graph.node.append(helper.make_node("Identity", ["logits"], ["features"]))
    onnx.save(graph, tmp_path / "tiny.onnx")
    ending(tmp_path / "tiny.onnx", *nodes)
    names = (data("ade31_teacher") / "mosaic_r4.txt").read_text().split("\n")[:32]
    (tmp_path / "classes.txt").write_text("\n".join(np.roll(names, moved)) + "\n")
    values = {
        "output": "logits",
        "labels": "classes.txt",
        "mean": [0.0] * 3,
        "std": [1.0] * 3,
        "base": 640,
    } | settings
    (tmp_path / "tiny.toml").write_text(
        "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())
    )
    found = dict(
        check(tmp_path / "tiny.onnx", sorted(data("redkitchen").glob("*.color.jpg"))[::15])
    )
    assert found[row].startswith(begins)
    others = {other for other, right in RIGHT.items() if not found[other].startswith(right)}
    assert others <= {row}
