"""The pages: self-contained, small, and what they show is what was measured."""

import base64
import csv
import html
import io
import json
import re
import shutil
from collections import Counter
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import BROWSER, browsed
from hostile import NAMES, Shape
from malformed.artifacts import artifacts, copied
from malformed.edits import changed
from PIL import Image
from shared import INPUTS, KEY, published, run_stage

from chebsplat.errors import InputError
from chebsplat.formats.artifact import publish, read_manifest
from chebsplat.formats.evaluation import Evaluation
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.manifest import Manifest
from chebsplat.stages import report
from chebsplat.stages.pages import pictures as draw
from chebsplat.stages.pages.measures import MEASURES, figures_of
from chebsplat.stages.pages.parts import beside_truth, class_rows, label_names, legend, picture_rows
from chebsplat.stages.training.defaults import DEFAULTS

pytestmark = pytest.mark.xdist_group("toy")


class Fetches(HTMLParser):
    """What a page would fetch, and the pictures it holds."""

    def __init__(self, text):
        super().__init__()
        self.fetched, self.pictures = [], {}
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.fetched += [
            v
            for k, v in attributes
            if k in ("src", "href", "xlink:href") and not v.startswith(("data:", "#"))
        ]
        if tag == "img" and "data-of" in values:
            self.pictures.setdefault(values["data-of"], []).append(values["src"])


def image(uri):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",", 1)[1]))).convert("RGB"))


def test_the_report_is_one_page_that_fetches_nothing(toy):
    text = (toy["report"] / "report.html").read_text()
    page = Fetches(text)
    assert page.fetched == []
    assert "@import" not in text
    assert "url(" not in text.replace("url(#", "")
    assert len(text) < 20_000_000
    assert text.count("<svg") == 4
    for told in ("LPIPS", "IoU by class", "Every setting", "make view scene="):
        assert told in text
    with (toy["report"] / "figures.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    for row in rows:
        assert all(not row[of] or np.isfinite(float(row[of])) for of in ("scene", "2D teacher"))
    scores = read_manifest(toy["evaluate"]).facts
    held = {row["figure"].partition(" (")[0]: row["scene"] for row in rows}
    assert float(held["mIoU, %"]) == pytest.approx(100 * scores["miou"])
    assert float(held["PSNR, dB"]) == pytest.approx(scores["psnr"])
    assert "Gaussians of SH degree 0" in held
    assert (toy["report"] / "trace.csv").read_text().startswith("step,seconds,")


def test_the_page_tells_what_the_scene_decided(toy):
    facts = read_manifest(toy["train"]).facts["decided"]
    assert facts.keys() == DEFAULTS.keys() - {"steps", "max_gaussians"}  # which the config names
    page = (toy["report"] / "report.html").read_text()
    assert all(
        f"<code>train.{name}</code>" in page and decided["by"] in page
        for name, decided in facts.items()
    )


def test_the_page_s_pictures_are_those_of_the_evaluation(toy):
    pictures = Fetches((toy["report"] / "report.html").read_text()).pictures
    stored = Evaluation.read(toy["evaluate"])
    assert set(pictures) == {"truth", "renders", "error", "labels", "teacher", "predicted", "wrong"}
    n = len(stored.figures["names"])
    assert 1 < n <= 4 and {len(of_kind) for of_kind in pictures.values()} == {n}
    colors = draw.palette(len(stored.figures["segmentation"]["classes"]))
    colors = np.concatenate([np.zeros((1, 3), np.uint8), colors])
    for k in range(n):
        for kind in ("truth", "renders"):
            apart = image(pictures[kind][k]).astype(float) - stored.pictures[kind][k]
            assert np.abs(apart).mean() < 3  # WebP at quality 90
        for kind in ("labels", "teacher", "predicted"):
            wanted = colors[stored.pictures[kind][k].astype(int) + 1]
            np.testing.assert_array_equal(image(pictures[kind][k]), wanted)


def test_labels_are_named_by_the_capture_and_otherwise_by_the_scene(toy, tmp_path):
    manifest = Manifest("chebsplat.scene/1", KEY, "export", {}, {}, 0)
    with publish(tmp_path / "scene", manifest) as out:
        (out / "labels.json").write_text(json.dumps({"0": "sofa", "1": "lamp"}))
    inputs = {"scene": tmp_path / "scene"}
    assert label_names(inputs, {}) == ["sofa", "lamp"]
    inputs["capture"] = toy["ingest"]
    classes = Evaluation.read(toy["evaluate"]).figures["segmentation"]["classes"]
    assert label_names(inputs, {}) == classes


def test_a_label_without_a_name_is_an_error_not_a_colour(toy, tmp_path):
    with pytest.raises(InputError, match="has no name"):
        picture_rows(Evaluation.read(toy["evaluate"]), ["wall"], 1, tmp_path)


def test_a_legend_names_the_labels_that_cover_most_and_how_many_more_there_are():
    names = [f"label {k}" for k in range(40)]
    colors = dict.fromkeys(names, "#000")
    pixels = Counter({k: 100 - k for k in range(40)} | {39: 1000})
    shown = legend(pixels, names, colors)
    assert [name for name, _ in shown] == [*names[:29], "label 39", "and 10 more"]
    assert len(legend(Counter({3: 1}), names, colors)) == 1


def test_classes_are_listed_best_first_and_those_that_never_occur_are_not():
    iou = {"wall": 0.2, "sofa": 0.9, "lamp": None}
    figures = {"segmentation": {"scene": {"iou": iou}, "teacher": {"iou": {"wall": 0.5}}}}
    rows = class_rows(figures, {"wall": "#1", "sofa": "#2"})
    assert rows == [("sofa", "#2", 0.9, None), ("wall", "#1", 0.2, 0.5)]


def test_true_classes_stand_beside_the_scene_s_labels_and_what_they_are_taken_for(toy, tmp_path):
    held = Evaluation.read(toy["evaluate"])
    truth = np.array([[[0, 0, 0, 0, 1, 1, -1, 2]]], np.int16)
    taken = np.array([[[0, 0, 1, -1, 1, 0, 0, 2]]], np.int16)
    held.pictures = {"labels": truth, "predicted": taken}
    names = ["wall", "floor", "lamp", "bed"]
    with publish(
        tmp_path / "scene", Manifest("chebsplat.scene/1", KEY, "export", {}, {}, 0)
    ) as out:
        (out / "labels.json").write_text(json.dumps({"0": "Floor", "1": "WALL"}))
    wall, floor, lamp = beside_truth(held, names, {"scene": tmp_path / "scene"})
    assert [row["label"] for row in (wall, floor, lamp)] == ["WALL", "Floor", None]
    assert [row["share"] for row in (wall, floor, lamp)] == [4 / 7, 2 / 7, 1 / 7]
    assert wall["taken"] == [("wall", 0.5), ("floor", 0.25), ("lamp", 0), ("anything else", 0.25)]
    assert floor["taken"] == [("wall", 0.5), ("floor", 0.5), ("lamp", 0), ("anything else", 0)]
    assert "Labels beside the truth" in (toy["report"] / "report.html").read_text()


def test_error_pictures_show_where_it_is_wrong_and_nowhere_else():
    truth = np.full((2, 2, 3), 100, np.uint8)
    render = truth.copy()
    render[0, 0] = 160
    shown = draw.error_map(render, truth).sum(-1)
    assert shown[0, 0] > shown[0, 1] == shown[1, 1]
    wrong = draw.wrong_map(np.array([[1, 2], [0, 0]]), np.array([[1, 1], [-1, 0]]))
    assert wrong[..., 3].tolist() == [[0, 255], [0, 0]]


def test_the_total_counts_every_stage_with_the_channels_and_no_size_exceeds_plain_3dgs(
    toy, tmp_path
):
    inputs = {role: toy[of] for role, of in INPUTS["report"].items()} | {
        "channels": toy["channels"]
    }
    assert run_stage("report", tmp_path / "report", inputs) == 0
    text = (tmp_path / "report/report.html").read_text()
    seconds = [read_manifest(path).seconds for path in inputs.values()]
    assert f"<b>{sum(seconds):.1f}</b>" in text
    assert "once for all scenes of one teacher" in text
    shares = re.findall(r"\((\d+)% of plain 3DGS\)", text)
    assert len(shares) == 2 and max(map(int, shares)) <= 100


def test_what_a_clock_has_measured_names_its_machine(toy, tmp_path):
    inputs = {}
    for role, stage, processor in (
        ("evaluation", "evaluate", "Slow 1"),
        ("gaussians", "train", "Fast 2"),
    ):
        inputs[role] = shutil.copytree(toy[stage], tmp_path / stage)
        manifest = json.loads((inputs[role] / "artifact.json").read_text())
        manifest["config"].get("train", {})["seconds"] = 60.0
        manifest["processes"][0] |= {
            "processor": processor,
            "threads": 3,
            "cores": 5,
            "load": [0.2, 1.9],
        }
        (inputs[role] / "artifact.json").write_text(json.dumps(manifest))
    assert run_stage("report", tmp_path / "report", inputs) == 0
    with (tmp_path / "report/figures.csv").open() as handle:
        rows = {row["figure"]: row["scene"] for row in csv.DictReader(handle)}
    assert "frames/s, colour (measured on Slow 1, 3 threads)" in rows
    assert any(
        name.startswith("ms a training step") and "measured on Fast 2, 3 threads" in name
        for name in rows
    )
    steps = Gaussians.read(toy["train"]).trace[-1]["step"]
    clock = "steps within 60 s by the clock (train.seconds, measured on Fast 2, 3 threads)"
    assert rows[clock] == f"{steps:g}"
    page = (tmp_path / "report/report.html").read_text()
    assert "Slow 1, 3 threads of 5 cores" in page and "0.2 to 1.9" in page and clock in page


def test_the_page_shows_the_error_of_every_stage_and_what_stopping_earlier_would_have_cost(
    toy, tmp_path
):
    inputs = {role: toy[stage] for role, stage in report.STAGE_OF.items() if stage in toy}
    assert run_stage("report", tmp_path / "report", inputs) == 0
    page = (tmp_path / "report/report.html").read_text()
    facts = {role: read_manifest(path).facts for role, path in inputs.items()}
    for stage in MEASURES.keys() - {"pose"}:
        for figure in figures_of(stage, facts):
            assert html.escape(figure, quote=True).replace("&#x27;", "&#39;") in page, stage
    told = page[page.index("What stopping earlier would have cost") :]
    assert all(
        f"<td>{words}</td>" in told for words in ("before training", "train", "lift", "refine")
    )
    assert (
        "not measured"
        not in page[page.index("error, and which way is better") : page.index("<b>total</b>")]
    )


def test_a_page_that_would_be_too_large_is_refused(toy, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "LARGEST", 1000)
    inputs = {"evaluation": toy["evaluate"], "gaussians": toy["train"]}
    assert run_stage("report", tmp_path / "report", inputs) == 4
    assert not (tmp_path / "report").exists()


in_a_browser = pytest.mark.skipif(
    BROWSER is None, reason="neither chromium nor google-chrome is installed"
)


@pytest.mark.slow
@in_a_browser
@pytest.mark.parametrize("wide", [1440, 390])
def test_in_a_browser_the_page_fits_its_width_without_an_error_or_a_request(toy, tmp_path, wide):
    seen, console, requests = browsed(tmp_path, (toy["report"] / "report.html").read_text(), wide)
    assert seen["problems"] == console == requests == []
    assert seen["wide"] <= wide
    assert seen["cut"] == []
    assert len(seen["shown"]) > 1
    assert all(seen["shown"])
    # one picture a side, and what lies over it; nothing is left over from the mode before
    assert seen["layers"] == {
        "photo | render": 2,
        "true labels | scene": 4,
        "2D teacher | scene": 4,
        "errors": 3,
    }


def reported(folder, names):
    """The report's page of a scene whose every name is one of these."""
    held = Evaluation.read(artifacts() / "evaluate")
    figures = json.loads(json.dumps(held.figures))
    iou = {"iou": dict.fromkeys(names, 0.5)}
    figures["segmentation"] |= {"classes": names, "scene": figures["segmentation"]["scene"] | iou}
    figures["source"] |= {"name": names[0], "kind": names[1], "notes": names}
    figures |= {"names": names[:1], "left_out": dict(zip(names, reversed(names), strict=True))}
    figures["protocol"] |= {"name": names[2], "split": names[3]}
    stacks = {key: stack[:] for key, stack in held.pictures.items()}
    stacks["labels"] = np.arange(stacks["labels"].size, dtype=np.int16).reshape(
        stacks["labels"].shape
    ) % len(names)
    inputs = {"evaluation": published(folder / "evaluation", Evaluation(figures, stacks))}
    assert (
        run_stage("report", folder / "report", inputs | {"gaussians": artifacts() / "train"}, {})
        == 0
    )
    return (folder / "report/report.html").read_text()


@pytest.mark.filterwarnings("ignore:No artists with labels")  # the small trace has one row
def test_names_are_text_of_the_report_and_never_markup(tmp_path):
    plain = Shape(reported(tmp_path / "plain", [f"name{k}" for k in range(len(NAMES))]))
    text = reported(tmp_path / "hostile", NAMES)
    hostile = Shape(text)
    assert hostile.tags == plain.tags
    for name in NAMES:
        assert hostile.text.count(name) >= 4  # legend, classes, notes, what is left out
    if BROWSER is not None:
        seen, console, requests = browsed(tmp_path, text, 390)
        assert seen["problems"] == console == requests == seen["cut"] == []


@pytest.mark.slow
@in_a_browser
def test_a_browser_would_notice_an_error_a_request_and_a_page_too_wide(tmp_path):
    page = (
        '<html><head></head><main><div style="overflow: auto"><p style="width: '
        '500px">text</p></div>'
    )
    page += (
        '<img src="http://a.invalid/x.png" style="width: '
        '500px"><script>nothing()</script></main></html>'
    )
    seen, console, requests = browsed(tmp_path, page, 390)
    assert seen["problems"]
    assert console
    assert requests
    assert seen["wide"] > 390
    assert [part.split(".")[0] for part in seen["cut"]] == ["DIV", "P", "IMG"]


@pytest.mark.filterwarnings("ignore:No artists with labels")  # the small trace has one row
def test_the_page_tells_how_far_views_agree_and_doubts_labels_where_they_do_not(tmp_path):
    inputs = {"evaluation": artifacts() / "evaluate", "gaussians": artifacts() / "train"}
    agreed = copied("agree", tmp_path)
    assert run_stage("report", tmp_path / "sure", inputs | {"agreement": agreed}, {}) == 0
    assert (
        "agreement of views on labels of 40 points" in (tmp_path / "sure/figures.csv").read_text()
    )
    assert "in doubt" not in (tmp_path / "sure/report.html").read_text()
    changed("artifact.json", lambda said: said["facts"].update(doubt="views agree by 0.01"))(agreed)
    assert run_stage("report", tmp_path / "unsure", inputs | {"agreement": agreed}, {}) == 0
    assert (
        "Labels are in doubt:</b> views agree by 0.01."
        in (tmp_path / "unsure/report.html").read_text()
    )
