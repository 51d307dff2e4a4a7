"""One segmenter brought in many ways: each says what the segmenter says, or a line names what was
in the way.
"""

import json

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from shared import published, run_stage
from tiny_teachers import COLORS, ending, moved_out, write_model

from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features

IMAGENET = {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}
SIGNED, RAW = {"mean": [0.5] * 3, "std": [0.5] * 3}, {"mean": [0.0] * 3, "std": [1.0] * 3}
BYTES = {"mean": [0.0] * 3, "std": [1 / 255] * 3}
CAFFE = {"mean": [0.406, 0.456, 0.485], "std": [1 / 255] * 3, "order": "BGR"}
POINTS = 0.5  # of mIoU that a way may cost without a word


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Four views of blocks in three colours, neither pure nor alike, and what they are."""
    rng = np.random.default_rng(0)
    labels = np.kron(rng.integers(0, 3, (4, 6, 8)), np.ones((1, 8, 8), np.int16)).astype(np.int16)
    colors = (
        np.array(list(COLORS.values()))[labels] * 60 + 127 + rng.normal(0, 20, (*labels.shape, 3))
    )
    record = Capture(
        [f"{k}.png" for k in range(4)], colors.clip(0, 255).astype(np.uint8),
        np.tile(np.eye(3), (4, 1, 1)), None,
        np.arange(4) == 0, labels=labels, class_names=list(COLORS),
    )  # fmt: skip
    return published(tmp_path_factory.mktemp("capture") / "capture", record)


def segmenter(folder, wants, *end, shape=(1, 3, "H", "W"), **toml):
    """A model of what it `wants` to be fed, and the TOML that says so; `end`: nodes after the
    logits.
    """
    path, kernel = (
        folder / "model.onnx",
        np.repeat(np.repeat(np.eye(3)[:, :, None, None], 4, 2), 4, 3) * 5 / 16,
    )
    turn = np.array([2, 1, 0] if wants.get("order") == "BGR" else [0, 1, 2])
    mean, std = (np.reshape(wants[key], (1, 3, 1, 1)) for key in ("mean", "std"))
    constants = {"kernel": kernel, "scale": 2 * std, "offset": 2 * mean - 1}
    nodes = [
        helper.make_node("Mul", ["image", "scale"], ["scaled"]),
        helper.make_node("Add", ["scaled", "offset"], ["fed"]),
        helper.make_node("Gather", ["fed", "turn"], ["colors"], axis=1),
        helper.make_node("Conv", ["colors", "kernel"], ["features"], strides=[4, 4]),
    ]
    held = {name: value.astype(np.float32) for name, value in constants.items()} | {"turn": turn}
    write_model(path, nodes, shape=shape, constants=held)
    (folder / "classes.txt").write_text("".join(f"{name}\n" for name in COLORS))
    values = {"output": "logits", "labels": "classes.txt", "multiple": 4} | wants | toml
    lines = [f"{key} = {json.dumps(value)}\n" for key, value in values.items() if value is not None]
    path.with_suffix(".toml").write_text("".join(lines))
    return ending(path, *end) if end else path


def node(operator, *inputs, **attributes):
    return operator, list(inputs), attributes


def beside(folder, location):
    moved_out(segmenter(folder, SIGNED), location)


def of_outputs(folder, *outputs, **toml):
    """A graph that gives these: its map, the same again, more channels, or no map (flat)."""
    path = segmenter(folder, SIGNED, **toml)
    model = onnx.load(path)
    model.graph.node.extend([
        helper.make_node("Identity", ["features"], ["same"]),
        helper.make_node("Concat", ["features", "features"], ["twice"], axis=1),
        helper.make_node("Concat", ["twice", "twice"], ["four"], axis=1),
        helper.make_node("Flatten", ["features"], ["flat"]),
    ])  # fmt: skip
    onnx.save(model, path)
    ending(path, outputs=outputs)


def likeliest(folder):
    path = segmenter(folder, SIGNED, node("ArgMax", axis=1, keepdims=0))
    model = onnx.load(path)
    model.graph.output[0].type.tensor_type.elem_type = TensorProto.INT64
    onnx.save(model, path)


def channels_last_in(folder):
    path = segmenter(folder, SIGNED)
    model = onnx.load(path)
    entry = helper.make_tensor_value_info("photo", TensorProto.FLOAT, (1, "H", "W", 3))
    model.graph.input[0].CopyFrom(entry)
    model.graph.node.insert(
        0, helper.make_node("Transpose", ["photo"], ["image"], perm=[0, 3, 1, 2])
    )
    onnx.save(model, path)


SOFTMAX, HALF, FLOAT = (
    node("Softmax", axis=1),
    node("Cast", to=TensorProto.FLOAT16),
    node("Cast", to=TensorProto.FLOAT),
)
WAYS = {  # how it is brought, and a word of what is said, "" where nothing need be
    "logits": (lambda f: segmenter(f, SIGNED), ""),
    "colours of 0 to 1": (lambda f: segmenter(f, RAW), ""),
    "ImageNet's mean and std": (lambda f: segmenter(f, IMAGENET), ""),
    "colours of 0 to 255": (lambda f: segmenter(f, BYTES), ""),
    "BGR of 0 to 255 less a mean": (lambda f: segmenter(f, CAFFE), ""),
    "a fixed size": (lambda f: segmenter(f, SIGNED, shape=(1, 3, 32, 32)), ""),
    "a size in the TOML": (lambda f: segmenter(f, SIGNED, size=[32, 48]), ""),
    "weights in .data": (lambda f: beside(f, "model.onnx.data"), ""),
    "weights in _data": (lambda f: beside(f, "model.onnx_data"), ""),
    "weights in weights.bin": (lambda f: beside(f, "weights.bin"), ""),
    "softmax": (lambda f: segmenter(f, SIGNED, SOFTMAX), "gives values of softmax, not logits"),
    "softmax in float16": (lambda f: segmenter(f, SIGNED, SOFTMAX, HALF, FLOAT),
                           "values of softmax"),
    "log-softmax": (lambda f: segmenter(f, SIGNED, node("LogSoftmax", axis=1)), ""),
    "sigmoid": (lambda f: segmenter(f, SIGNED, node("Sigmoid")), "values of sigmoid"),
    "cosines": (lambda f: segmenter(f, SIGNED, node("LpNormalization", axis=1)),
                "values of cosines"),
    "no output in the TOML": (lambda f: segmenter(f, SIGNED, output=None),
                              "has no `output`: logits"),
    "no map first": (lambda f: of_outputs(f, "flat", "features"), ": features is taken"),
    "a map of other channels first": (lambda f: of_outputs(f, "twice", "features"),
                                      ": features is taken"),
    "two maps alike": (
        lambda f: of_outputs(f, "features", "same"), "same [1, 3, 12, 16]: more than one fits"
    ),
    "two maps alike, one named": (lambda f: of_outputs(f, "features", "same", tensor="same"), ""),
    "two maps alike, none of that name": (
        lambda f: of_outputs(f, "features", "same", tensor="sane"),
        "no output is called sane: there are features [1, 3"
    ),
    "no map that fits": (lambda f: of_outputs(f, "twice", "four"), "none fits"),
    "channels last": (lambda f: segmenter(f, SIGNED, node("Transpose", perm=[0, 2, 3, 1])),
                      "channels come last"),
    "the likeliest class alone": (likeliest, "the likeliest class alone"),
    "and as numbers": (lambda f: segmenter(f, SIGNED, node("ArgMax", axis=1), FLOAT),
                       "names 3 classes"),
    "channels last, of photos": (channels_last_in, "one image [1, 3, H, W] is needed"),
    "mean and std of 0 to 255": (
        lambda f: segmenter(f, IMAGENET, mean=[123.675, 116.28, 103.53],
                            std=[58.395, 57.12, 57.375]),
        "write mean = [0.485, 0.456, 0.406], std = [0.229, 0.224, 0.225]",
    ),
    "Caffe's mean and std": (
        lambda f: segmenter(f, CAFFE, mean=[104.0, 117.0, 123.0], std=[1, 1, 1]),
        "write mean = [0.4078, 0.4588, 0.4824], std = [0.003922, 0.003922, 0.003922]",
    ),
    "a name too many": (
        lambda f: (segmenter(f, SIGNED),
                   (f / "classes.txt").write_text("background\nred\ngreen\nblue\n")),
        "names 4 classes",
    ),
    "weights left behind": (
        lambda f: (beside(f, "weights.bin"), (f / "weights.bin").unlink()), "weights.bin is missing"
    ),
}  # fmt: skip


def miou(said, truth):
    """Of maps of the same size, in per cent."""
    unions = [((said == k) | (truth == k)).sum() for k in range(3)]
    return 100 * np.mean(
        [((said == k) & (truth == k)).sum() / union for k, union in enumerate(unions)]
    )


@pytest.mark.parametrize("way", WAYS)
def test_a_segmenter_says_the_same_however_it_is_brought_or_a_line_says_why_not(
    tmp_path, capture, capsys, way
):
    bring, word = WAYS[way]
    bring(tmp_path)
    config = {"teacher": {"model": str(tmp_path / "model.onnx")}}
    code = run_stage("teacher", tmp_path / "out", {"capture": capture}, config)
    said = capsys.readouterr().err
    assert word in said
    if code:
        assert code == 3 and word
        return
    found = Features.read(tmp_path / "out")
    assert miou(found.pseudo_labels[:], Capture.read(capture).labels[:, ::4, ::4]) > 100 - POINTS
    scores = next((kind for kind in ("softmax", "sigmoid", "cosines") if kind in word), "logits")
    assert found.convention["scores"] == scores
