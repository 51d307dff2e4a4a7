"""Exactly what a change makes stale runs again, and nothing else."""

import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import onnxruntime
import pytest
from malformed.sources import write_slam
from shared import ROOT, finish, photo_folder, remember
from source_folders import write_colmap

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.encoding import Encoding
from chebsplat.formats.knowledge import SHIPPED, read_knowledge
from chebsplat.formats.teacher_model import EMBEDDED
from chebsplat.pipelines.planning.code import PACKAGE
from chebsplat.pipelines.planning.plan import Planner, suffix
from chebsplat.pipelines.planning.raw import content_hash, hashes
from chebsplat.pipelines.planning.sequences import scenes_of
from chebsplat.pipelines.running.run import failures, needed_steps
from chebsplat.pipelines.work import store
from chebsplat.pipelines.work.scenes import CONFIGS, names, read_toml
from chebsplat.stages.registry import OF_KNOWLEDGE, STAGES
from chebsplat.stages.shape_models.answers import answered, inputs_of

# of a source with poses
PLANNED = {name for name, stage in STAGES.items() if stage.of_scene} - {"pose"}
KNOWING = "knowledge.start=rooms"  # the toy starts from none by itself
ALL = [name for name in STAGES if name in PLANNED - {"channels", "recall"}]  # of a first scene
ABOUT_SHAPE = ["describe", "encode", "learn", "onnx"]
AFTER_TRAIN = ["train", "lift", "refine", "export", "evaluate", "report"]


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch, code_memo):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work folder"))
    monkeypatch.delenv("REPLICA_ROOT", raising=False)
    monkeypatch.chdir(ROOT)
    return remember(tmp_path / "work folder", code_memo)


@pytest.fixture
def source_tree(tmp_path):
    """A copy of the code that a test may edit."""
    return shutil.copytree(
        PACKAGE, tmp_path / "code/chebsplat", ignore=shutil.ignore_patterns("__pycache__")
    )


def stale(package=PACKAGE, scene="toy", settings=KNOWING):
    planner = Planner(package)
    plan = planner.plan(scene, settings)
    planner.save()
    return [step.stage for step in plan.steps if not step.fresh]


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def touch(tree):
    os.utime(tree / "training/trainer.py", (1, 1))


def comment(tree):
    edit(tree / "training/trainer.py", "class Trainer", "# a remark\n\n\nclass Trainer")


def docstring(tree):
    edit(tree / "stages/ingest.py", '"""ingest: ', '"""ingest, that is ')


def plumbing(tree):
    edit(tree / "stages/runtime/progress.py", "every: float = 6.0", "every: float = 5.0")


def trainer_code(tree):
    edit(tree / "training/schedule.py", '"means": 0.01', '"means": 0.02')


def deep_code(tree):
    edit(tree / "synthetic/textures.py", "0.95 * light", "0.96 * light")


def report_code(tree):
    edit(tree / "stages/pages/report.html", "<h2>Test views</h2>", "<h2>Views</h2>")


def descriptor_code(tree):
    edit(tree / "shape/albo.py", "\nimport torch\n", "\nimport torch\n\nEXTRA = 1\n")


def format_code(tree):
    edit(tree / "formats/scene.py", "/ 127)", "/ 126)")


CODE_CHANGES = [
    (touch, []),
    (comment, []),
    (docstring, []),
    (plumbing, []),
    (report_code, ["report"]),
    (format_code, ["export", "evaluate", "report"]),
    (trainer_code, AFTER_TRAIN),
    (descriptor_code, [*ABOUT_SHAPE, "refine", "export", "evaluate", "report"]),
    (deep_code, ALL),
]


@pytest.mark.parametrize(
    ("change", "expected"), CODE_CHANGES, ids=lambda v: getattr(v, "__name__", "")
)
def test_a_change_of_code_makes_exactly_these_stages_stale(tmp_path, source_tree, change, expected):
    finish(Planner(source_tree).plan("toy", KNOWING))
    assert stale(source_tree) == []
    before = shutil.copytree(tmp_path / "code", tmp_path / "before")
    change(source_tree)
    assert stale(source_tree) == expected
    shutil.copytree(before, tmp_path / "code", copy_function=shutil.copyfile, dirs_exist_ok=True)
    assert stale(source_tree) == []


SETTING_CHANGES = [
    ("train.steps=61", AFTER_TRAIN),
    ("train.prune=off", AFTER_TRAIN),
    ("teacher.confusion=0.2", ["teacher", "agree", "learn", *AFTER_TRAIN]),
    ("agree.n_points=700", ["agree", "report"]),
    ("describe.bandwidth=0.8", [*ABOUT_SHAPE, *AFTER_TRAIN]),
    ("sfm.max_points=700", ["sfm", "agree", *ABOUT_SHAPE, *AFTER_TRAIN]),
    ("lift.gate=0.3", ["lift", "refine", "export", "evaluate", "report"]),
    ("refine.smooth=on", ["refine", "export", "evaluate", "report"]),
    ("evaluate.boundary=3", ["evaluate", "report"]),
    ("source.seed=7", ALL),
    ("train.steps=60", []),
]


@pytest.mark.parametrize(
    ("settings", "expected"), SETTING_CHANGES, ids=lambda v: v if isinstance(v, str) else ""
)
def test_a_change_of_setting_makes_exactly_these_stages_stale(settings, expected):
    settings = f"{KNOWING},{settings}"
    finish(Planner().plan("toy", KNOWING))
    assert stale(settings=settings) == expected
    finish(Planner().plan("toy", settings))
    assert stale() == []
    assert stale(settings=settings) == []


def test_content_of_raw_files_counts_and_their_time_and_place_do_not(tmp_path):
    scene = photo_folder(tmp_path / "photos")
    finish(Planner().plan(scene))
    assert stale(scene=scene) == []
    os.utime(tmp_path / "photos/1.jpg", (5, 5))
    assert stale(scene=scene) == []
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    shutil.move(tmp_path / "photos", moved / "photos")
    assert stale(scene=f"{moved}/photos/") == []
    shutil.copy(moved / "photos/1.jpg", moved / "photos/2.jpg")
    # left out: nobody named a teacher
    semantic = ("teacher", "agree", "lift", "refine", *OF_KNOWLEDGE)
    assert stale(scene=f"{moved}/photos/") == [
        "pose",
        *(stage for stage in ALL if stage not in semantic),
    ]


def test_a_raw_file_under_another_folder_is_other_content(tmp_path):
    for part in ("semantic", "instance"):
        (tmp_path / part).mkdir()
        (tmp_path / part / "0.png").write_bytes(b"same")
    found = [hashes([tmp_path / part / "0.png"], {}) for part in ("semantic", "instance")]
    semantic, instance = (content_hash(some, tmp_path) for some in found)
    assert semantic != instance


def test_paths_are_those_of_the_user_s_folder_not_of_the_stage_s(tmp_path, monkeypatch):
    photo_folder(tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    keys = set()
    for path in ("photos", "~/photos", "${NO_SUCH_VARIABLE:-.}/photos", str(tmp_path / "photos")):
        plan = Planner().plan("toy", f"teacher.kind=none,source.kind=photos,source.path={path}")
        assert plan.steps[0].sections["source"]["path"] == str(tmp_path / "photos")
        keys.add(plan.steps[-1].key)
    assert len(keys) == 1
    for name in ("model.onnx", "table.npz", "names.txt"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "model.toml").write_text('labels = "table.npz"')
    settings = "teacher.kind=onnx,teacher.model=model.onnx,teacher.labels=names.txt"
    plan = Planner().plan("toy", settings)
    teacher = next(step for step in plan.steps if step.stage == "teacher")
    assert teacher.sections["teacher"]["kind"] == "onnx"
    assert teacher.sections["teacher"]["model"] == str(tmp_path / "model.onnx")
    for name in ("model.onnx", "model.toml", "table.npz", "names.txt"):
        (tmp_path / name).write_text('labels = "table.npz"  # another')
        again = Planner().plan("toy", settings)
        changed = [a.stage for a, b in zip(plan.steps, again.steps, strict=True) if a.key != b.key]
        assert changed == [
            *(["channels"] if name != "names.txt" else []),
            "teacher",
            "agree",
            *AFTER_TRAIN,
        ]
        plan = again


def teacher_of(*arguments):
    return next(
        step for step in Planner().plan(*arguments).steps if step.stage == "teacher"
    ).sections["teacher"]


def test_the_embedded_teacher_is_used_unless_another_is_asked_for(tmp_path):
    photos = photo_folder(tmp_path / "photos")
    for scene in (("office0",), ("toy", "teacher.kind=auto"), (photos, "teacher.kind=embedded")):
        teacher = teacher_of(*scene)
        assert (teacher["kind"], teacher["model"]) == ("onnx", str(EMBEDDED))
    assert (
        teacher_of("toy")["kind"]
        == teacher_of("office0", "teacher.kind=labels")["kind"]
        == "labels"
    )


def test_photos_without_labels_get_no_teacher_unasked_and_learn_how_to_get_one(tmp_path):
    plan = Planner().plan(photo_folder(tmp_path / "photos"))
    assert "teacher" not in plan.targets
    assert all(
        told in plan.left_out["teacher"]
        for told in ("get-teacher", "docs/teachers.md", "kind=embedded")
    )
    assert "evaluate" in plan.targets


def test_a_training_waits_for_the_agreement_of_views_and_reads_nothing_of_it():
    steps = {step.stage: step for step in Planner().plan("toy").steps}
    assert steps["train"].after == [steps["agree"].path]
    assert steps["agree"].path not in steps["train"].inputs.values()
    plan = Planner().plan("toy")
    assert "agree" in [step.stage for step in needed_steps(plan, "train")]
    assert Planner().plan("toy", "teacher.kind=none").targets.keys() & {"agree"} == set()


@pytest.mark.parametrize("kind", ["labels", "none", "embedded"])
def test_a_model_that_would_not_be_used_is_an_error(kind):
    with pytest.raises(ConfigError, match=r"teacher\.kind=onnx"):
        Planner().plan("toy", f"teacher.kind={kind},teacher.model=model.onnx")


def test_a_folder_without_letters_is_named_with_the_folders_above_it(tmp_path):
    photo_folder(tmp_path / "statue" / "dense" / "0")
    assert Planner().plan(f"{tmp_path}/statue/dense/0").title.startswith("dense-0-")


def test_a_scene_may_be_any_folder_that_no_scene_is_named_after(tmp_path, monkeypatch):
    for name in ("photos", "store", ".hidden", "toy"):
        photo_folder(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert re.fullmatch("photos-[0-9a-f]{4}", Planner().plan("photos").title)
    assert re.fullmatch("store-[0-9a-f]{4}", Planner().plan("store").title)
    assert Planner().plan(".hidden").title.startswith("hidden-")
    assert "generated" in Planner().plan("toy").source


def test_long_settings_name_different_folders():
    text = "train.steps=12,train.n_densify=1,sfm.max_points=200,describe.n_regions=12,train.seed="
    assert suffix("train.albo=off") == "train.albo=off"
    assert suffix(text + "1") != suffix(text + "2")
    assert len(suffix(text + "1")) == 80


def test_generated_and_replica_scenes_never_share_a_key(tmp_path, monkeypatch):
    generated = Planner().plan("office0")
    assert "generated" in generated.source
    assert "REPLICA_ROOT is not set" in generated.source
    write_slam(tmp_path / "replica/office_0")
    monkeypatch.setenv("REPLICA_ROOT", str(tmp_path / "replica"))
    real = Planner().plan("office0")
    assert "replica" in real.source
    keys = {s.key for s in generated.steps}
    shared = {s.stage for s in real.steps if s.key in keys}
    assert shared == {"channels"}  # the teacher's, not the scene's


@pytest.mark.parametrize(
    ("settings", "left_out"),
    [
        ("", {"channels"}),
        (KNOWING, {"channels"}),
        ("train.semantics=false", {"channels", "teacher", "agree", "lift", "refine"}),
        ("teacher.kind=none", {"channels", "teacher", "agree", "lift", "refine"}),
        ("train.features=lifted", {"channels"}),
        ("train.method=printed", {"channels", "lift", "refine"}),
    ],
)
def test_a_scene_leaves_out_what_it_does_not_need_and_says_why(settings, left_out):
    plan = Planner().plan("toy", settings)
    left_out |= {"recall"} if settings == KNOWING else set(OF_KNOWLEDGE)
    assert {what for what in plan.left_out if what in STAGES} == left_out | {"pose"}
    assert all(plan.left_out.values())
    assert PLANNED - left_out == set(plan.targets)


def test_the_printed_method_is_refused_where_nothing_teaches_it():
    with pytest.raises(ConfigError, match=r"needs a teacher, and teacher\.kind is none"):
        Planner().plan("toy", "teacher.kind=none", "paper")


def test_lifted_features_reach_the_export_and_trained_ones_do_not_wait_for_them():
    by_stage = {
        step.stage: set(step.inputs)
        for step in Planner().plan("toy", "train.features=lifted").steps
    }
    assert by_stage["train"] == {"capture", "points"}
    assert by_stage["lift"] == {"capture", "gaussians", "features"}
    assert by_stage["refine"] == {"capture", "gaussians", "features", "lifted"}
    assert by_stage["export"] == {"gaussians", "features", "refined"}
    by_stage = {step.stage: set(step.inputs) for step in Planner().plan("toy").steps}
    assert by_stage["export"] == {"gaussians", "features", "refined"}
    assert "features" in by_stage["train"]


def test_a_finished_scene_of_colours_is_named_later_without_training_it_again():
    without = ("teacher.kind=none", "train.semantics=false", "train.features=lifted")
    plans = [{s.stage: s.key for s in Planner().plan("toy", of).steps} for of in (*without, "")]
    assert len({plan["train"] for plan in plans[:3]}) == 1
    assert plans[3]["train"] != plans[0]["train"]
    assert {"lift", "refine"} <= plans[2].keys() and "lift" not in plans[0]


@pytest.mark.parametrize("kind", ["scenes", "qualities", "ablations", "sequences"])
def test_every_config_of_ours_can_be_planned(kind, tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_TEST_DATA", str(tmp_path))
    assert len(names(kind)) == len(list((CONFIGS / kind).iterdir()))
    for name in names(kind):
        if kind == "ablations":
            assert Planner().plan("toy", ablation=name).title == f"toy@{name}"
        elif kind == "qualities":
            plan = Planner(quality=name).plan("toy", "train.steps=9", "plain")
            assert plan.title == f"toy@{name}+plain+train.steps=9"
            sides = {"draft": 640, "standard": 1000, "high": 1600}
            sections = {step.stage: step.sections for step in plan.steps}
            assert sections["ingest"]["ingest"]["max_side"] == sides[name]
        elif kind == "sequences":
            assert set(scenes_of(name)) <= set(names("scenes"))
        elif "path" in read_toml(kind, name)["source"]:
            folder = read_toml(kind, name)["source"]["path"].partition("}/")[2]
            with pytest.raises(InputError, match=str(tmp_path / folder)):
                Planner().plan(name)
        else:
            assert Planner().plan(name).title == name


def test_labels_cannot_be_asked_of_a_source_without_them(tmp_path):
    with pytest.raises(ConfigError, match=r"teacher\.model"):
        Planner().plan(photo_folder(tmp_path / "photos"), "teacher.kind=labels")


def test_links_name_artifacts_and_clean_stale_finds_what_nothing_names(work):
    plan, other = Planner().plan("toy"), Planner().plan("toy", "train.steps=9")
    finish(plan)
    finish(other)
    store.link(plan.title, plan.targets)
    assert (work / "toy/train").resolve() == plan.targets["train"]
    leftover = plan.targets["train"].with_name(".tmp-abc-999999999")
    leftover.mkdir()
    found = {path for path, _ in store.list_unreferenced()}
    assert found == {leftover, *(other.targets[s] for s in AFTER_TRAIN)}
    for path in found:
        store.remove(path)
    assert store.list_unreferenced() == []
    assert all(store.is_fresh(path) for path in plan.targets.values())


def test_relinking_drops_stages_that_are_left_out_and_keeps_those_still_to_run(work):
    whole, less = Planner().plan("toy"), Planner().plan("toy", "train.semantics=false")
    finish(whole)
    store.link("toy", whole.targets)
    store.link("toy", less.targets)
    assert not (work / "toy/teacher").is_symlink()
    assert (work / "toy/ingest").resolve() == less.targets["ingest"]
    assert (work / "toy/train").resolve() == whole.targets["train"]


def running_plan(work, plan, pid):
    steps = [
        {"path": str(s.path), "inputs": {r: str(p) for r, p in s.inputs.items()}}
        for s in plan.steps
    ]
    folder = work / f".plans/abc-{pid}"
    folder.mkdir(parents=True)
    (folder / "plan.json").write_text(json.dumps({"steps": steps}))
    return folder


def test_clean_stale_spares_what_a_running_plan_makes_and_reads(work):
    plan = Planner().plan("toy")
    finish(plan)
    scratch = plan.targets["sfm"].with_name(f".part-{plan.targets['sfm'].name}")
    scratch.mkdir()
    os.utime(scratch, (1, 1))
    folder = running_plan(work, plan, os.getpid())
    assert store.list_unreferenced() == []
    folder.rename(dead := folder.with_name("abc-999999999"))
    assert {path for path, _ in store.list_unreferenced()} == {
        dead,
        scratch,
        *plan.targets.values(),
    }


def test_a_failed_run_tells_a_stage_that_failed_from_one_that_was_killed(tmp_path, capfd):
    steps = {step.stage: step for step in Planner().plan("toy").steps}
    for step in steps.values():  # as a plan is written
        (tmp_path / f"{step.stage}-{step.key}.exit").write_text("0")
    for stage in ("lift", "train"):
        (tmp_path / f"{stage}-{steps[stage].key}.log").touch()
    (tmp_path / f"lift-{steps['lift'].key}.exit").write_text("4")
    outcome = failures(list(steps.values()), tmp_path, tmp_path / "snakemake.log")
    assert outcome.code == 4
    assert set(outcome.failed) == {steps["lift"].key, steps["train"].key}
    told = capfd.readouterr().err
    assert "lift failed with exit code 4" in told
    assert "train was killed" in told
    assert failures([steps["report"]], tmp_path, tmp_path / "snakemake.log").code == 1
    assert "snakemake.log" in capfd.readouterr().err


def chebsplat(*arguments, **environment):
    command = [sys.executable, "-m", "chebsplat.pipelines.cli", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, env=os.environ | environment
    )


FAST = "train.steps=12,train.n_densify=1,sfm.max_points=200,describe.n_regions=12"


def check_encoder(scene):
    """The graph in a scene's folder answers as torch does."""
    knowledge, described = read_knowledge(SHIPPED), Descriptors.read(scene / "describe")
    wanted = Encoding.read(scene / "encode").features.astype(np.float32) @ knowledge.map
    assert len(wanted) > 100
    inputs = inputs_of(scene, described, knowledge)
    given = inputs._asdict() | {"neighbors": inputs.neighbors.astype(np.int64)}
    runner = onnxruntime.InferenceSession(
        scene / "onnx/encoder.onnx", providers=["CPUExecutionProvider"]
    )
    answers = runner.run(None, given)[0]
    np.testing.assert_allclose(answers, answered(knowledge, inputs), atol=1e-4)
    np.testing.assert_allclose(answers, wanted, atol=2e-2)  # of features in half precision


@pytest.mark.xdist_group("cli")
def test_a_run_makes_the_report_and_a_second_run_does_nothing(work):
    first = chebsplat("run", "--scene", "toy", "--set", FAST, "--knowledge", "rooms")
    assert first.returncode == 0, first.stderr
    page = first.stdout.strip()
    assert page == str(next(work.glob("toy@*")) / "report/report.html")
    assert os.path.isfile(page)
    assert "to run: ingest" in first.stderr
    table = {
        line.strip().split("  ")[0] for line in first.stderr.splitlines() if line.startswith("  ")
    }
    assert {"test PSNR", "mIoU", "Gaussians", "PLY"} <= table
    assert "its 2D teacher" in first.stderr
    times = {p: p.stat().st_mtime_ns for p in work.glob("store/*/*/artifact.json")}
    assert len(times) == len(ALL) + 1  # what ships is in the store, too
    assert list(json.loads((work / "toy/pin.json").read_text()).values()) == [[]]
    check_encoder(next(work.glob("toy@*")))
    assert chebsplat("knowledge", "verify").stdout == "rooms: 1 lessons, whole\n"
    shown = chebsplat("knowledge", "show").stdout.splitlines()[1].split()
    assert shown[:2] == chebsplat("knowledge", "log").stdout.split()[1:]
    assert "its labels were given" in " ".join(shown)
    second = chebsplat("run", "--scene", "toy", "--set", f"{FAST},{KNOWING}")
    assert second.returncode == 0
    assert second.stdout.strip() == page
    assert "to run" not in second.stderr
    assert times == {p: p.stat().st_mtime_ns for p in work.glob("store/*/*/artifact.json")}
    only = chebsplat("run", "--scene", "toy", "--set", f"{FAST},{KNOWING},evaluate.boundary=3")
    assert f"to run: evaluate report   fresh: {len(ALL) - 2}" in only.stderr
    assert "report: done" in only.stderr
    assert "already there" not in only.stderr
    assert "profile" not in first.stderr + only.stderr
    assert not list(work.glob(".plans/*"))
    part = chebsplat("run", "--scene", "toy", "--set", f"{FAST},{KNOWING}", "--stage", "sfm")
    assert part.stdout.endswith(f"{os.sep}sfm\n")
    assert chebsplat("clean-stale").stdout.split()[:2] == ["0.0", "MB"]
    checked = chebsplat("verify", *(str(p.parent) for p in times))
    assert checked.returncode == 0, checked.stderr


@pytest.mark.xdist_group("cli")
def test_folders_may_be_called_what_a_shell_yaml_or_snakemake_take_for_their_own(tmp_path):
    name = "Anna's {room} #1: $5 `touch x`; touch x"
    scene, work = f"{write_colmap(tmp_path / name)}/", tmp_path / "work" / name
    done = chebsplat(
        "run", "--scene", scene, "--stage", "ingest", "--cores", "1", CHEBSPLAT_WORK=str(work)
    )
    assert done.returncode == 0, done.stderr
    assert list(work.glob("*/ingest/artifact.json"))
    assert not (ROOT / "x").exists() and not (work / "x").exists()


@pytest.mark.xdist_group("cli")
def test_a_failing_stage_gives_its_exit_code_and_nothing_half_made(work):
    failed = chebsplat(
        "run", "--scene", "toy", "--set", "ingest.test_every=10000,ingest.test_offset=9999," + FAST
    )
    assert failed.returncode == 4
    told = next(
        line
        for line in failed.stderr.splitlines()
        if line.startswith("ingest failed with exit code 4; log: ")
    )
    with open(told.split("log: ")[1]) as log:
        assert "test view" in log.read()
    assert not list(work.glob("store/ingest/*"))


@pytest.mark.xdist_group("cli")
def test_runs_at_the_same_time_make_every_artifact_once(work):
    command = [
        sys.executable,
        "-m",
        "chebsplat.pipelines.cli",
        "run",
        "--scene",
        "toy",
        "--stage",
        "describe",
        "--set",
    ]
    settings = [f"{FAST},{KNOWING}"] * 3 + [f"{FAST},{KNOWING},describe.bandwidth=0.8"]
    runs = [
        subprocess.Popen(
            [*command, some], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for some in settings
    ]
    said = [run.communicate() for run in runs]
    assert [run.returncode for run in runs] == [0] * len(runs), said
    lines = "".join(error for _, error in said)
    assert [lines.count(f"{stage}: done") for stage in ("ingest", "sfm", "describe")] == [1, 1, 2]
    assert len({out for out, _ in said}) == 2
    assert not [path for path in work.glob("store/*/.*") if path.is_dir()]


def test_help_of_every_stage_shows_its_options_and_needs_no_heavy_import():
    script = (
        "import sys\nfrom chebsplat.pipelines.cli import main\n"
        f"for stage in {list(STAGES)!r}:\n"
        "    try: main([stage, '--help'])\n"
        "    except SystemExit as stop: assert not stop.code\n"
        "heavy = {'torch', 'numba', 'open3d', 'pycolmap', 'zarr', 'scipy', 'matplotlib'} & "
        "set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("--out PATH") == len(STAGES)
    for stage in STAGES.values():
        assert all(f"--in-{role}" in done.stdout for role in stage.roles)
