"""Studies: what they expand to, what they compute again (nothing), and the tables they make."""

import csv
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from browser import BROWSER, browsed
from hostile import NAMES, Shape, shown_in
from malformed.edits import put
from matplotlib.figure import Figure
from shared import ROOT

from chebsplat.errors import ConfigError
from chebsplat.formats.artifact import publish
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import Evaluation
from chebsplat.formats.manifest import Manifest
from chebsplat.pipelines.planning import plan
from chebsplat.pipelines.studies import figures
from chebsplat.pipelines.studies.page import write
from chebsplat.pipelines.studies.pictures import gallery
from chebsplat.pipelines.studies.results import compare, on_one_machine, row_of, traces
from chebsplat.pipelines.studies.study import (
    checked_study,
    execute,
    expand,
    outstanding,
    read_study,
)
from chebsplat.pipelines.studies.tables import Section, sections
from chebsplat.pipelines.work.scenes import data_of, names, read_toml
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.config import build


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.delenv("REPLICA_ROOT", raising=False)
    return tmp_path / "work"


def study(**changes):
    values = {"title": "T", "about": "A", "scenes": ["toy"], "seeds": [0, 1], "baseline": "less"}
    values |= {"variants": {"full": {}, "less": {"ablation": "features-only"}}}
    return checked_study(values | changes, "study")


def step_of(run, stage):
    return next(step for step in run.plan.steps if step.stage == stage)


def publish_stage(run, stage, fill, machine="A", **facts):
    """An artifact of a run, without running it. fill: what writes its files into a folder."""
    step = step_of(run, stage)
    if step.fresh:
        return
    code = {"commit": "c" * 40, "dirty": False}
    manifest = Manifest(
        STAGES[stage].schema, step.key, stage, {}, step.sections, 0, facts, code=code
    )
    manifest.processes = [
        {
            "processor": machine,
            "gpu": "",
            "cores": 4,
            "threads": 2,
            "load": [0.5, 1],
            "seconds": 9.0,
        }
    ]
    step.path.parent.mkdir(parents=True, exist_ok=True)
    with publish(step.path, manifest) as tmp:
        fill(tmp)


ONE_LABEL = np.zeros((1, 4, 6), np.int16)


def finish(
    run,
    miou=0.5,
    psnr=30.0,
    n=100,
    seconds=10.0,
    steps=10,
    segmentation=None,
    labels=None,
    machine="A",
):
    """Pretend that a run was made and found these figures. labels: (class names, predicted i16 [1,
    4, 6]).
    """
    figures = {
        "image": {"psnr": psnr, "ssim": 0.9},
        "n_gaussians": n,
        "bytes": {"ply": 10 * n, "ragged": 5 * n},
    }
    figures |= {
        "frames_per_second": {"color": 50.0},
        "protocol": {"resolution": "6x4", "split": "all"},
    }
    whole = {"miou": miou, "macc": miou, "oa": miou, "boundary_miou": miou}
    figures["segmentation"] = segmentation or {"scene": whole, "teacher": whole | {"miou": 0.25}}
    if labels is not None:
        blank, K = np.zeros((1, 4, 6, 3), np.uint8), np.eye(3)[None]
        truth = np.zeros((1, 4, 6), np.int16)
        capture = Capture(
            ["a"], blank, K, np.eye(4)[None], np.array([True]), labels=truth, class_names=labels[0]
        )
        publish_stage(run, "ingest", capture.write)
    for step in run.steps:
        if step.stage not in ("train", "export", "evaluate"):
            publish_stage(run, step.stage, put("empty.json", "{}"))
    trace = f"step,seconds,psnr\n{steps // 2},{seconds / 2},20\n{steps},{seconds},25\n"
    publish_stage(run, "train", put("trace.csv", trace), machine)
    # 10 Gaussians keep degree 3 (16 coefficients) and 30 degree 0 (1): 190 of 640.
    publish_stage(run, "export", put("empty.json", "{}"), by_degree=[30, 0, 0, 10])
    figures |= {"names": ["a"], "left_out": {"LPIPS": "not measured"}}
    figures["image"]["per_view"] = {"psnr": [psnr]}
    pictures = {name: np.zeros((1, 4, 6, 3), np.uint8) for name in ("truth", "renders")}
    if labels is not None:
        pictures |= {"labels": truth, "predicted": labels[1]}
    publish_stage(run, "evaluate", Evaluation(figures, pictures).write, machine)


def finished(asked, **figures):
    """Runs of a study as if they had been made and had found these figures, and a row of results of
    each.
    """
    runs = expand(asked)
    for run in runs:
        finish(run, **figures)
    return runs, [row_of(run, {}) for run in runs]


def test_a_study_is_every_combination_and_each_step_once():
    conditions = {
        "a": {"teacher": {"kind": "labels"}},
        "b": {"teacher": {"kind": "labels", "confusion": 0.1}},
    }
    runs = expand(study(conditions=conditions, budgets={"steps": [10, 20]}))
    assert len(runs) == 2 * 2 * 2 * 2
    assert (
        len({run.name for run in runs}) == len({run.plan.targets["evaluate"] for run in runs}) == 16
    )
    counts = [step.stage for step in outstanding(runs)]
    assert {stage: counts.count(stage) for stage in counts} == {
        "ingest": 1, "sfm": 1, "teacher": 4, "agree": 4, "train": 16, "lift": 8,
        "refine": 8, "export": 16, "evaluate": 16,
    }  # fmt: skip
    settings = [step.sections["train"] for step in outstanding(runs) if step.stage == "train"]
    assert {(s["steps"], s["seed"], s["prune"]) for s in settings} == {
        (steps, seed, prune) for steps in (10, 20) for seed in (0, 1) for prune in (True, False)
    }


def test_a_budget_of_seconds_is_a_training_by_the_clock_beside_one_of_steps():
    runs = expand(study(seeds=[0], budgets={"steps": [10], "seconds": [2.5, 60]}))
    trained = [(run.budget, step_of(run, "train").sections["train"]) for run in runs]
    found = {(budget, settings["steps"], settings["seconds"]) for budget, settings in trained}
    own = step_of(expand(study())[0], "train").sections["train"]["steps"]
    assert found == {("10 steps", 10, None), ("2.5 s", own, 2.5), ("60 s", own, 60)}
    assert len({run.plan.targets["train"] for run in runs}) == 6


def test_only_a_teacher_that_draws_is_computed_for_every_seed():
    for teacher, count in (({"kind": "auto"}, 1), ({"kind": "labels"}, 2)):
        steps = outstanding(expand(study(settings={"teacher": teacher})))
        assert [step.stage for step in steps].count("teacher") == count


def test_what_is_there_is_not_computed_again_and_is_kept(work):
    first, _ = finished(study(seeds=[0]))
    assert outstanding(first) == []
    assert execute("s", first, 1, 1).code == 0
    assert len(list((work / "study-s").iterdir())) == 2
    more = outstanding(expand(study(seeds=[0, 1], settings={"teacher": {"kind": "labels"}})))
    assert {step.sections["train"]["seed"] for step in more if step.stage == "train"} == {1}
    assert "ingest" not in {step.stage for step in more}


def test_figures_are_read_from_the_artifacts():
    asked = study(seeds=[3], variants={"less": {}})
    _, (row,) = finished(asked, miou=0.75, psnr=31.5, n=40, seconds=8.0)
    expected = {
        "state": "done",
        "seed": 3,
        "miou": 0.75,
        "miou_gain": 0.5,
        "psnr": 31.5,
        "n_gaussians": 40,
    }
    expected |= {"miou_teacher": 0.25, "boundary_miou_teacher": 0.75, "point_miou_teacher": None}
    expected |= {
        "sh_kept": 190 / 640,
        "bytes_ply": 400,
        "bytes_ragged": 200,
        "frames_per_second": 50.0,
    }
    expected |= {"lpips": None, "resolution": "6x4", "split": "all"}
    expected |= {"train_seconds": 8.0, "held_in_psnr": 25.0, "steps": 10, "clock": None}
    expected |= {"trained_on": "A, 2 threads", "rendered_on": "A, 2 threads"}
    assert {key: row[key] for key in expected} == expected


def compared(runs, rows, baseline="less"):
    return {line.variant: line for line in compare(rows, baseline)}


def test_the_table_says_what_a_hand_works_out():
    runs = expand(study(scenes=["toy", "office0"]))
    miou = {("toy", 0): 0.50, ("toy", 1): 0.54, ("office0", 0): 0.60, ("office0", 1): 0.60}
    for run in runs:
        full = run.variant == "full"
        finish(run, miou[run.scene, run.seed] + (0.02 if full else 0), n=50 if full else 100)
    lines = compared(runs, [row_of(run, {}) for run in runs])
    assert lines["less"].summaries["miou"].mean == pytest.approx(0.56)
    # .06² + .02² + 2 × .04²
    assert lines["less"].summaries["miou"].spread == pytest.approx((0.0072 / 3) ** 0.5)
    assert lines["less"].differences == {}
    gain = lines["full"].differences["miou"]
    assert (gain.mean, gain.n_pairs, gain.n_units) == (pytest.approx(0.02), 4, 2)
    assert gain.excluded
    assert lines["full"].differences["n_gaussians"].mean == pytest.approx(0.5)
    assert not lines["full"].differences["psnr"].excluded


def test_seconds_of_two_machines_are_not_compared_and_the_page_says_whose_it_shows(tmp_path):
    asked = study(scenes=["toy", "office0"], budgets={"steps": [10, 20], "seconds": [5]})
    runs = expand(asked)
    for run in runs:  # B has one scene's runs of a seed: twice as fast, and as good
        on_b = (run.scene, run.seed) == ("office0", 1)
        seconds = (8.0 if run.variant == "full" else 10.0) / (1 + on_b)
        finish(run, psnr=30 + on_b, seconds=seconds, machine="B" if on_b else "A")
    rows = [row_of(run, {}) for run in runs]
    kept, _ = on_one_machine(rows)
    assert on_one_machine(kept)[0] == kept
    for row, given in zip(kept, rows, strict=True):
        left = given["trained_on"] == "B, 2 threads"
        assert (row["train_seconds"], row["frames_per_second"]) == (
            (None, None) if left else (given["train_seconds"], 50.0)
        )
        by_clock = "its 5 s are of another machine (B, 2 threads): not compared"
        assert row["state"] == (by_clock if left and row["budget"] == "5 s" else "done")
        assert row["psnr"] == given["psnr"]
    lines = {(line.budget, line.variant): line for line in compare(kept, "less")}
    ratio = lines["20 steps", "full"].differences["train_seconds"]
    assert (ratio.mean, ratio.n_pairs) == (pytest.approx(0.8), 3)
    assert lines["20 steps", "full"].differences["psnr"].n_pairs == 4  # which no machine changes
    assert lines["5 s", "full"].differences["psnr"].n_pairs == 3
    assert lines["20 steps", "less"].summaries["train_seconds"].mean == 10
    page = write(tmp_path, asked, runs, rows, "c", sections(asked, rows))
    for text in (page.read_text(), (tmp_path / "results.md").read_text().replace("\\", "")):
        assert (
            "training, s" in text
            and ("is of the 18 runs on A, 2 threads alone; not compared: 6 on B") in text
        )
        assert "A, 2 threads; B, 2 threads" in text and "0.5 to 1" in text and by_clock in text
    with (tmp_path / "results.csv").open() as handle:
        assert {row["trained_on"] for row in csv.DictReader(handle)} == {
            "A, 2 threads",
            "B, 2 threads",
        }


def test_a_study_of_one_machine_bewares_of_nothing(tmp_path):
    asked = study(seeds=[0])
    page = write(tmp_path, asked, *finished(asked, machine="C"), "c").read_text()
    assert "C, 2 threads" in page and "beware" not in page


def test_scannet_open_sums_its_scenes_and_scannet_closed_averages_before_seeds_are_compared(
    tmp_path,
):
    # truth and prediction of wall and floor, in pixels           alone            summed, as
    # scannet-open has it toy      wall 9 right, 1 taken for floor; floor 1 right     (9/10 + 1/2)/2
    # wall 9/19, floor
    # 1/11 office0  floor 9, all taken for wall                        0                its mean:
    # (9/19 +
    # 1/11)/2
    a, b = ([[0] * 20 for _ in range(20)] for _ in range(2))
    a[0][0], a[0][1], a[1][1], b[1][0] = 9, 1, 1, 9
    alone, summed = {"toy": (0.7, a), "office0": (0.0, b)}, (9 / 19 + 1 / 11) / 2
    for protocol, expected in (("scannet-open", summed), ("scannet-closed", 0.35)):
        asked = study(scenes=list(alone), settings={"ingest": {"protocol": protocol}})
        runs = expand(asked)
        for run in runs:
            miou, matrix = alone[run.scene]
            if (run.variant, run.seed) == ("full", 1):  # a seed in which every pixel is right
                miou, matrix = (
                    1.0,
                    [
                        [sum(row) if k == j else 0 for j in range(20)]
                        for k, row in enumerate(matrix)
                    ],
                )
            finish(run, segmentation={"scene": {"miou": miou, "confusion": matrix}})
        rows = [row_of(run, {}) for run in runs]
        lines = compared(runs, rows)
        assert (lines["less"].summaries["miou"].mean, lines["less"].summaries["miou"].n) == (
            pytest.approx(expected),
            2,
        )
        assert lines["full"].summaries["miou"].mean == pytest.approx((expected + 1) / 2)
        gain = lines["full"].differences["miou"]
        assert (gain.mean, gain.n_pairs) == (pytest.approx((1 - expected) / 2), 2)
        assert lines["full"].differences["psnr"].n_pairs == 4
        page = write(tmp_path / protocol, asked, runs, rows, "c").read_text()
        assert "all scenes of a seed together" in page and f"<dd>{protocol}</dd>" in page
        # without one of its scenes, a seed is no partner of the whole one
        rows[0] = row_of(runs[0], {}) | {"state": "not run yet"}
        assert (rows[0]["scene"], rows[0]["seed"], rows[0]["variant"]) == ("toy", 0, "full")
        assert compared(runs, rows)["full"].differences["miou"].n_pairs == 1


def test_scenes_measured_in_two_ways_are_not_compared(tmp_path, monkeypatch):
    known = plan.scene_values
    office = {"ingest": {"protocol": "replica-f3"}}

    def values(scene):
        title, own, *rest = known(scene)
        return title, plan.merged(own, office if scene == "office0" else {}), *rest

    monkeypatch.setattr(plan, "scene_values", values)
    with pytest.raises(ConfigError, match="as labels and as replica-f3 do not compare"):
        expand(study(scenes=["toy", "office0"]))


def test_the_page_shows_a_view_of_each_scene_in_one_set_of_colours(tmp_path):
    asked = study(scenes=["toy", "office0"], budgets={"steps": [10, 20]})
    runs = expand(asked)
    classes = {"toy": ["wall", "sofa"], "office0": ["sofa", "lamp"]}
    for run in runs:
        iou = {"sofa": 0.5, "wall": None} if run.variant == "less" else {"sofa": 0.75, "wall": 0.25}
        found = np.full((1, 4, 6), classes[run.scene].index("sofa"), np.int16)
        if (run.scene, run.variant, run.seed) != ("office0", "full", 0):
            finish(run, segmentation={"scene": {"iou": iou}}, labels=(classes[run.scene], found))
    rows = [row_of(run, {}) for run in runs]
    shown = gallery(asked, runs, rows)
    assert [row["name"] for row in shown["pictures"]] == ["toy", "office0"]
    toy, office = ({key: uri for key, uri, _ in row["images"]} for row in shown["pictures"])
    assert (
        toy["labels of less"] == toy["labels of full"] == office["labels of less"] != toy["labels"]
    )
    # that run has failed; the slider says so by a button that is off
    assert "render of full" not in office
    assert [name for name, _ in shown["legend"]] == ["wall", "sofa"]
    classes = [(name, mean, other) for name, _, mean, other in shown["classes"]]
    assert classes == [("sofa", 0.75, 0.5), ("wall", 0.25, None)]
    assert shown["shown"] == "20 steps, seed 0"
    names = [
        "photo | full",
        "true labels | full",
        "photo | less",
        "less | full",
        "less | full, labels",
    ]
    assert [mode[0] for mode in shown["modes"]] == names
    page = write(tmp_path, asked, runs, rows, "c").read_text()
    assert page.count("data-of=") == 6 + 4
    if BROWSER is not None:  # which ends on the scene that lacks a variant
        seen, console, _ = browsed(tmp_path, page, 1440)
        assert seen["problems"] == console == []
        assert len(seen["shown"]) == 2 and all(seen["shown"])
    assert (
        '<td class="w">LPIPS</td><td class="w">not measured</td><td class="w" '
        'data-label="by">all</td>'
    ) in page


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="neither chromium nor google-chrome is installed")
@pytest.mark.parametrize("wide", [1440, 390])
def test_in_a_browser_nothing_of_a_crowded_study_is_cut_off(tmp_path, wide):
    values = {
        "conditions": {f"noise {p}": {"teacher": {"confusion": p}} for p in (0.1, 0.3)},
        "baseline": "plain-3dgs",
    }
    values |= {
        "variants": {
            "plain-3dgs": {},
            "feature-3dgs equivalent": {"train": {"sh_prune": False}},
            "less": {},
        }
    }
    asked = study(**values, scenes=["toy", "office0"], budgets={"steps": [1000, 3000]})
    runs = expand(asked)
    for k, run in enumerate(runs):
        finish(
            run,
            0.71 + 0.004 * k,
            31.2 + 0.1 * k,
            25_000 + 791 * k,
            300 + k,
            labels=(["wall", "sofa"], ONE_LABEL),
        )
    rows = [row_of(run, {}) | {"point_miou": 0.5 + 0.01 * k} for k, run in enumerate(runs)]
    section = Section(
        "More", "By place.", [["a", "b", *["mIoU − its 2D teacher's, points"] * 6], ["x"] * 8]
    )
    page = write(tmp_path, asked, runs, rows, "make study=crowded", [section]).read_text()
    seen, console, requests = browsed(tmp_path, page, wide)
    assert seen["problems"] == console == requests == seen["cut"] == []
    assert seen["wide"] <= wide


def named_study(folder, names):
    """A study whose title, conditions, variants and labels have these names: its page and its
    Markdown.
    """
    variants = {name: {"train": {"seed": k}} for k, name in enumerate(names[::4])}
    asked = study(title=names[0], about=names[1], seeds=[0], baseline=names[0], variants=variants,
                  conditions={names[2]: {"teacher": {"kind": "labels"}}})  # fmt: skip
    runs = expand(asked)
    for run in runs[:-1]:
        finish(
            run,
            segmentation={"scene": {"iou": dict.fromkeys(names, 0.5)}},
            labels=(names, ONE_LABEL),
        )
    rows = [row_of(run, {}) | {"miou": 0.5} for run in runs[:-1]] + [row_of(runs[-1], {})]
    section = Section(names[3], names[4], [["what", "figure"], *([name, "1"] for name in names)])
    page = write(folder, asked, runs, rows, f"make study={names[5]}", [section]).read_text()
    return page, (folder / "results.md").read_text()


def test_names_are_text_of_a_study_and_never_markup(tmp_path, work):
    plain, _ = named_study(tmp_path / "plain", [f"name{k}" for k in range(len(NAMES))])
    page, markdown = named_study(tmp_path / "hostile", NAMES)
    assert Shape(page).tags == Shape(plain).tags
    assert "<" not in markdown.replace("<br>", "")
    ours = markdown.replace("![error against run time]", "")
    assert not re.search(r"(?<!\\)(?:\\\\)*[`_{}\[$]", ours)
    for name in NAMES:
        assert name in Shape(page).text
        assert name in shown_in(markdown)
    if BROWSER is not None:
        seen, console, requests = browsed(tmp_path, page, 390)
        assert seen["problems"] == console == requests == seen["cut"] == []


def test_a_run_that_failed_is_named_and_counts_in_no_mean(tmp_path):
    toys = study()
    runs = expand(toys)
    broken = next(run for run in runs if (run.variant, run.seed) == ("full", 1))
    waiting = next(run for run in runs if (run.variant, run.seed) == ("less", 0))
    for run in runs:
        if run not in (broken, waiting):
            finish(run, miou=0.4)
    failed = {broken.plan.targets["train"].name: (4, "step 7: loss color is not finite", tmp_path)}
    rows = [row_of(run, failed) for run in runs]
    lines = compared(runs, rows)
    assert [(lines[v].n_done, lines[v].n_runs) for v in ("full", "less")] == [(1, 2), (1, 2)]
    assert lines["full"].differences == {}  # no seed has both
    page = write(tmp_path / "out", toys, runs, rows, "make study=toys")
    for text in (page.read_text(), (tmp_path / "out/results.md").read_text()):
        assert "train failed with exit code 4: step 7: loss color is not finite" in text
        assert "seed 0: not run yet" in text
        assert "make study=toys" in text
    with (tmp_path / "out/results.csv").open() as handle:
        states = [row["state"] for row in csv.DictReader(handle)]
    assert states.count("done") == 2


def test_without_a_single_result_the_page_says_so(tmp_path):
    runs = expand(study(seeds=[0]))
    page = write(tmp_path, study(seeds=[0]), runs, [row_of(run, {}) for run in runs], "c")
    assert page.read_text().count("not run yet") == 2


@pytest.fixture
def panels(monkeypatch):
    """The axes of every figure that is saved."""
    axes, save = [], Figure.savefig

    def saved(figure, *args, **options):
        axes.extend(figure.axes)
        save(figure, *args, **options)

    monkeypatch.setattr(Figure, "savefig", saved)
    return axes


def test_a_figure_against_a_setting_has_a_point_where_each_condition_sets_it(tmp_path, panels):
    conditions = {f"p{p}": {"teacher": {"kind": "labels", "confusion": p}} for p in (0.5, 0.0)}
    noise = study(seeds=[0], conditions=conditions, against="teacher.confusion")
    runs = expand(noise)
    for run in runs:
        finish(run, miou={"p0.5": 0.4, "p0.0": 0.6}[run.condition], psnr=31.5)
    write(tmp_path, noise, runs, [row_of(run, {}) for run in runs], "c")
    points = [[line.get_xydata().tolist() for line in panel.lines[:2]] for panel in panels]
    for values, drawn in zip(([60, 40], [35, 15], [31.5, 31.5]), points, strict=True):
        assert drawn == [pytest.approx(np.stack([[0, 0.5], values], 1))] * 2, values
    assert {panel.get_xlabel() for panel in panels} == {"teacher.confusion"}


def test_a_figure_of_colour_alone_has_a_panel_for_each_scene(tmp_path, panels):
    runs, rows = finished(study(scenes=["toy", "office0"], seeds=[0]))
    figures.draw(tmp_path / "figure.png", rows, traces(runs, rows), None, "")
    assert [panel.get_title()[:9] for panel in panels] == ["test PSNR", "test mIoU", "PSNR on w"]
    panels.clear()
    figures.draw(
        tmp_path / "figure.png",
        [row | {"miou": None} for row in rows],
        traces(runs, rows),
        None,
        "",
    )
    assert [panel.get_title() for panel in panels] == ["toy", "office0"]
    # test views, and the trace of views trained on
    assert all(len(panel.lines) >= 2 for panel in panels)


@pytest.mark.parametrize("name", names("studies"))
def test_every_study_of_ours_can_be_planned(name):
    found = read_study(name)
    if found.tables:
        pytest.skip("tables of a paper: tests/pipelines/studies/test_published.py")
    there = [
        scene for scene in found.scenes if (needed := data_of(scene)) is None or needed[1].is_dir()
    ]
    if not there:
        pytest.skip(f"{', '.join(found.scenes)}: no data (CHEBSPLAT_TEST_DATA)")
    runs = expand(found.model_copy(update={"scenes": there[:1], "seeds": found.seeds[:1]}))
    assert {run.variant for run in runs} == set(found.variants)


# Variants that are a method or a recipe of their own, not another but for one thing.
METHODS = {"full", "default", "paper", "features-only", "plain", "classic", "published"}
# and those that differ from one of these in several settings that are one thing, their name
TOGETHER = {
    "classic-alone": {"refine.start", "refine.smooth", "knowledge.start"},  # nothing after training
    "plain, no cap": {"train.max_gaussians", "train.grow_threshold"},  # as far as the published
}


def chosen(variant):
    """Every setting of a variant by section.key."""
    variant = dict(variant)
    ablation = variant.pop("ablation", "")
    config = build(
        plan.merged(read_toml("ablations", ablation) if ablation else {}, variant), "variant"
    )
    return {f"{s}.{k}": v for s, of in config.model_dump().items() for k, v in of.items()}


@pytest.mark.parametrize("name", names("studies"))
def test_a_variant_differs_from_another_in_the_one_thing_that_it_is_called_for(name):
    found = read_study(name)
    whole = [{}, *({"ablation": ablation} for ablation in ("plain", "classic"))]
    for variant, values in found.variants.items():
        if variant in METHODS:
            assert values in ({}, {"ablation": variant}), variant
            continue
        others = [of for other, of in found.variants.items() if other != variant]
        apart = [
            {key for key, value in chosen(values).items() if chosen(of)[key] != value}
            for of in (*others, *whole)
        ]
        wanted = TOGETHER.get(variant)
        assert wanted in apart if wanted else any(len(keys) == 1 for keys in apart), variant


def test_a_study_that_extends_another_has_its_values_but_for_its_own_and_names_what_it_takes():
    base = read_study("parts")
    own = {"extends": "parts", "title": "T", "seeds": [7], "variants": ["no-ash", "full"]}
    found = checked_study(own, "mine")
    assert (found.title, found.seeds) == ("T", [7])
    assert (found.about, found.scenes, found.budgets) == (base.about, base.scenes, base.budgets)
    assert found.variants == {name: base.variants[name] for name in ("no-ash", "full")}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"extends": "prats"}, "no study is called prats; did you mean parts"),
        ({"extends": "method-long"}, "mine: method-long itself extends parts; extend that"),
        ({"variants": ["full", "half"]}, "mine: variants: 'half' is none of full, features-only"),
        ({"conditions": ["noise"]}, "mine: conditions: 'noise' is none of"),
        ({"variants": ["plain"]}, "'full' is none of its variants"),
    ],
)
def test_an_extension_of_what_is_not_there_is_an_error_that_names_it(changes, message):
    with pytest.raises(ConfigError, match=message):
        checked_study({"extends": "parts"} | changes, "mine")


@pytest.mark.slow
@pytest.mark.xdist_group("cli")
def test_a_study_goes_on_after_a_failure_and_a_second_call_computes_only_what_failed(
    tmp_path, work
):
    (tmp_path / "vgg.safetensors").write_text("no weights")
    (tmp_path / "mine.toml").write_text(f"""
title = "Mine"
about = "Two runs, of which one breaks."
scenes = ["toy"]
baseline = "whole"
[settings]
teacher = {{ kind = "labels" }}
sfm = {{ max_points = 200 }}
describe = {{ n_regions = 12 }}
train = {{ steps = 12, n_densify = 1, report_every = 6 }}
[variants.whole]
[variants.breaks]
evaluate = {{ lpips_weights = "{tmp_path}/vgg.safetensors" }}
train = {{ sh_degree = 2 }}
""")
    command = [
        sys.executable,
        "-m",
        "chebsplat.pipelines.cli",
        "study",
        str(tmp_path / "mine.toml"),
    ]
    command += ["--cores", "1", "--threads", "2", "--out", str(tmp_path / "out")]
    for to_run in (
        "1 ingest, 1 sfm, 1 teacher, 1 agree, 2 train, 2 lift, 2 refine, 2 export, 2 evaluate",
        "1 evaluate",
    ):
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=os.environ)
        assert done.returncode == 3, done.stderr
        assert f"toy, seed 0: to run: {to_run}; 1 at once, 1 threads each" in done.stderr
        assert done.stdout.strip() == str(tmp_path / "out/study.html")
        with (tmp_path / "out/results.csv").open() as handle:
            states = {row["variant"]: row["state"] for row in csv.DictReader(handle)}
        assert states["whole"] == "done"
        assert states["breaks"].startswith("evaluate failed with exit code 3: ")
    assert len(list(work.glob("store/evaluate/*/artifact.json"))) == 1
