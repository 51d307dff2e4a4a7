"""Teachers by the address of their ONNX file: a path, a file: URL, and a server of our own."""

import os
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper
from served import Quiet, served
from tiny_teachers import COLORS, color_teacher, moved_out, write_model

from chebsplat.errors import ChebsplatError, ConfigError, InputError
from chebsplat.formats.onnx_files import model_sha256
from chebsplat.formats.teacher_model import read_teacher
from chebsplat.stages.tools.get_teacher import get_teacher

OTHER = "0" * 64


class Cut(Quiet):
    """Says the whole length of a model, and sends a part."""

    def copyfile(self, source, outputfile):
        content = source.read()
        outputfile.write(content[:100] if self.path.endswith(".onnx") else content)


class Odd(Quiet):
    """Says a length that is no number."""

    def send_header(self, keyword, value):
        super().send_header(keyword, "odd" if keyword == "Content-Length" else value)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A segmenter of colours on offer, in a folder whose name a URL has to quote, a folder to stand
    in, and a small photo for the check.
    """
    photo = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    monkeypatch.setattr("chebsplat.stages.tools.get_teacher.read_photo", lambda _: ("photo", photo))
    (tmp_path / "on offer").mkdir()
    (tmp_path / "here").mkdir()
    model = color_teacher(tmp_path / "on offer", output="logits", labels="the colours.txt")
    (model.parent / "the colours.txt").write_text("\n".join(COLORS) + "\n")
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.chdir(tmp_path / "here")
    return model


def toml(model, **values):
    lines = dict(
        line.split(" = ", 1) for line in model.with_suffix(".toml").read_text().splitlines()
    )
    lines |= values
    model.with_suffix(".toml").write_text("".join(f"{k} = {v}\n" for k, v in lines.items()))


@pytest.mark.parametrize("kind", ["path", "file", "http"])
@pytest.mark.parametrize("features", [False, True])
def test_an_onnx_file_becomes_a_teacher_wherever_it_lies(place, tmp_path, kind, features):
    if features:
        toml(place, output='"features"', labels='"tiny.npz"')
    moved_out(place, "weights.bin")
    with served(place.parent) as server:
        address = {
            "path": "../on offer/tiny.onnx",
            "file": place.as_uri(),
            "http": f"{server}/tiny.onnx?download=true",
        }[kind]
        model, findings = get_teacher(address)
        again = get_teacher(address, sha256=model_sha256(place).upper())
    assert str(model) == "tiny/tiny.onnx" and again[0] == model
    kept = "tiny.labels.npz" if features else "tiny.labels.txt"
    names = {"tiny.onnx", "tiny.toml", "weights.bin", kept}
    assert {path.name for path in model.parent.iterdir()} == names
    found, origin = read_teacher(model), address if kind == "http" else str(place)
    assert (found.mean, found.multiple) == ((0.5,) * 3, 4)
    assert os.path.realpath(found.origin) == os.path.realpath(origin)
    assert found.sha256 == model_sha256(place) and found.labels == model.with_name(kept)
    assert f"--sha256 {found.sha256}" in dict(findings)["sha256"] and "sees" in dict(findings)
    assert "sha256" not in dict(again[1])
    assert not list(tmp_path.rglob(".part-*"))


def test_a_name_that_a_url_quotes_is_read_as_it_is(place):
    for path in (place, place.with_suffix(".toml")):
        path.rename(path.with_stem("my tiny"))
    with served(place.parent) as server:
        model, _ = get_teacher(f"{server}/my%20tiny.onnx")
    assert str(model) == "my tiny/my tiny.onnx"


def test_what_brings_no_toml_takes_the_user_s_own(place, tmp_path):
    (tmp_path / "mine").mkdir()
    for name in ("tiny.toml", "the colours.txt"):
        (place.parent / name).rename(tmp_path / "mine" / name)
    with served(place.parent) as server:
        with pytest.raises(InputError, match=r"answers 404; write a TOML .* --settings FILE.toml"):
            get_teacher(f"{server}/tiny.onnx")
        model, _ = get_teacher(f"{server}/tiny.onnx", settings="../mine/tiny.toml")
        with pytest.raises(ConfigError, match=r"tiny exists and keeps its TOML, .*remove it"):
            get_teacher(f"{server}/tiny.onnx", settings="../mine/tiny.toml")
    assert read_teacher(model).labels.read_text().split() == list(COLORS)


def test_a_checksum_that_was_asked_for_is_compared(place, tmp_path):
    toml(place, sha256=f'"{OTHER}"')
    with pytest.raises(InputError, match=f"{OTHER} was asked for"):
        get_teacher(str(place))  # by its publisher's TOML
    with pytest.raises(InputError, match=f"{'1' * 64} was asked for"):
        get_teacher(str(place), sha256="1" * 64)
    assert not list((tmp_path / "here").iterdir())
    model, _ = get_teacher(str(place), sha256=model_sha256(place))
    with pytest.raises(InputError, match=f"{OTHER} was asked for"):
        get_teacher(str(place), sha256=OTHER)
    assert model.is_file()


def last_axes(path):
    model = onnx.load(path)
    model.graph.output[0].name = "flat"
    model.graph.node.append(helper.make_node("Flatten", ["features"], ["flat"]))
    onnx.save(model, path)


def renamed_weights(path, name):
    moved_out(path, "weights.bin")
    model = onnx.load(path, load_external_data=False)
    tensors = [*model.graph.initializer, *(a.t for n in model.graph.node for a in n.attribute)]
    for entry in (entry for tensor in tensors for entry in tensor.external_data):
        entry.value = name if entry.key == "location" else entry.value
    path.write_bytes(model.SerializeToString())


REFUSED = {
    "a page": (lambda f: f.write_text("<!DOCTYPE html>"), "is no ONNX graph, it begins with b'<!"),
    "nothing": (lambda f: f.write_bytes(b""), "is no ONNX graph"),
    "another rank": (
        lambda f: write_model(f, [helper.make_node("Identity", ["image"], ["features"])],
                              shape=(1, 3, "N")),
        r"one image \[1, 3, H, W\] is needed",
    ),
    "no class map": (last_axes, r"\[1, C, h, w\] is needed"),
    "other classes": (lambda f: (f.parent / "the colours.txt").write_text("red\n"), "3 channels"),
    "no model": (lambda f: f.unlink(), "answers 404; correct the address"),
    "no labels": (lambda f: (f.parent / "the colours.txt").unlink(), "answers 404; correct"),
    "a date in the TOML": (lambda f: toml(f, mean="1979-05-27"), "three numbers"),
    "weights that are missing": (
        lambda f: (moved_out(f, "weights.bin"), (f.parent / "weights.bin").unlink()),
        "keeps weights there",
    ),
    "weights of ours": (
        lambda f: renamed_weights(f, "../ghts.bin"),
        r"^http\S*/tiny.onnx has weights outside",
    ),
    "weights of no name": (
        lambda f: renamed_weights(f, "weig\0ts/bin"),
        r"^http\S*/tiny.onnx has weights outside",
    ),
    "weights at a location of nothing": (
        lambda f: renamed_weights(f, ""),
        r"^http\S*/tiny.onnx has weights .*in no file \('\.'\)",
    ),
    "weights in the folder itself": (
        lambda f: renamed_weights(f, "a/.."),
        r"^http\S*/tiny.onnx has weights .*in no file \('\.'\)",
    ),
    "weights below the TOML": (
        lambda f: renamed_weights(f, "tiny.toml/x"),
        "/x: tiny.toml is the name of two files; rename one",
    ),
    "a list of sides": (lambda f: toml(f, base="[1]"), r"^http\S*/tiny.toml: base = \[1\]"),
    "weights in the place of labels": (lambda f: moved_out(f, "tiny.labels.txt"), "of two files"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_teacher_is_one_line_and_leaves_no_folder(place, tmp_path, case):
    damage, word = REFUSED[case]
    damage(place)
    with served(place.parent) as server, pytest.raises(InputError, match=word) as error:
        get_teacher(f"{server}/tiny.onnx")
    assert "\n" not in str(error.value) and not list((tmp_path / "here").iterdir())


@pytest.mark.parametrize(
    ("address", "word"),
    [
        ("http://nowhere.invalid/tiny.onnx", "no host called nowhere.invalid is found"),
        ("http://127.0.0.1:9/tiny.onnx", "is not reached .*connect and run"),
        ("http://127.0.0.1:x/tiny.onnx", "is not reached"),
        ("http://127.0.0.1:9/tiny.tflite", "is TFLite, .*python -m tf2onnx.convert"),
        ("nowhere/tiny.onnx", "nowhere/tiny.toml is missing; write a TOML"),
        ("ftp://127.0.0.1/tiny.onnx", "is missing"),
        *(
            (f"http://127.0.0.1:9/{end}", "names no file; give the address of the .onnx itself")
            for end in ("", "models/", "..", "%2e%2e", "?of=tiny.onnx", "a%00.onnx")
        ),
        (
            f"http://127.0.0.1:9/{'x' * 300}.onnx",
            r"^x+\.\.\. cannot be written .*give it a shorter name",
        ),
        (f"{'x' * 250}.onnx", r"^\.part-x+\.\.\. cannot be written"),
    ],
)
def test_what_is_not_reached_or_read_is_one_line(place, address, word):
    with pytest.raises(ChebsplatError, match=word) as error:
        get_teacher(address)
    assert "\n" not in str(error.value) and not list(Path().iterdir())


def test_an_address_as_long_as_a_presigned_one_is_kept(place):
    with served(place.parent) as server:
        model, _ = get_teacher(address := f"{server}/tiny.onnx?signature={'x' * 4000}")
    assert read_teacher(model).origin == address


@pytest.mark.parametrize(
    ("handler", "word"), [(Cut, "broke off at 100 of"), (Odd, "is not reached .*'odd'")]
)
def test_a_download_that_broke_off_is_no_teacher(place, tmp_path, handler, word):
    with served(place.parent, handler) as server, pytest.raises(InputError, match=word):
        get_teacher(f"{server}/tiny.onnx")
    assert not list((tmp_path / "here").iterdir())


def test_a_toml_of_others_takes_no_file_of_ours(place, tmp_path):
    (tmp_path / "secret.txt").write_text("\n".join(COLORS))
    for name in (str(tmp_path / "secret.txt"), "../secret.txt", (tmp_path / "secret.txt").as_uri()):
        toml(place, labels=f'"{name}"')
        with served(place.parent) as server, pytest.raises(InputError, match="answers 404"):
            get_teacher(f"{server}/tiny.onnx")


@pytest.mark.parametrize(
    ("name", "options", "word"),
    [
        ("segformer-b0-ade", {"settings": "a.toml"}, "brings its own"),
        ("a.onnx", {"graph": "b.onnx"}, "--file is of the hub's"),
        ("http://[x/a.onnx", {}, "is no teacher"),
    ],
)
def test_options_that_would_do_nothing_and_addresses_that_are_none_are_refused(name, options, word):
    with pytest.raises(ConfigError, match=word):
        get_teacher(name, **options)
