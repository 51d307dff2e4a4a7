"""Scenes in order: what a change of the order makes stale, and what a given basis means."""

import pytest
from shared import ROOT

from chebsplat.errors import ConfigError
from chebsplat.pipelines.planning.plan import Planner, overrides
from chebsplat.pipelines.planning.sequences import chain, scenes_of
from chebsplat.pipelines.running.run import wanted_steps
from chebsplat.pipelines.selection import checked_stage, plans

BEFORE_TRAIN = {"ingest", "sfm", "teacher", "agree", "describe"}
LABELS = "teacher.kind=labels"


@pytest.fixture(autouse=True, scope="module")
def work(tmp_path_factory):
    """Nothing is made in it but what planners remember of the code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CHEBSPLAT_WORK", str(tmp_path_factory.mktemp("work")))
        patch.delenv("REPLICA_ROOT", raising=False)
        patch.chdir(ROOT)
        yield


@pytest.fixture
def sequence(tmp_path):
    """Writes a sequence of the user's own."""

    def write(*scenes, name="mine"):
        (tmp_path / f"{name}.toml").write_text(f"scenes = {list(scenes)}".replace("'", '"'))
        return str(tmp_path / f"{name}.toml")

    return write


def keys(path):
    """By scene: its steps' keys by stage."""
    planner = Planner()
    found = chain(planner, path, LABELS)
    planner.save()
    return [
        (scene, {step.stage: step.key for step in plan.steps})
        for scene, plan in zip(scenes_of(path), found, strict=True)
    ]


ORDER = ("toy", "office0", "office1", "room0")
CHANGES = [  # the new order, and what stays as it was: scenes that come before the change
    (("toy", "room1", "office0", "office1", "room0"), {"toy"}),
    (("room1", *ORDER), set()),
    ((*ORDER, "room1"), set(ORDER)),
    (("toy", "office1", "room0"), {"toy"}),
    (("toy", "office0", "office1"), {"toy", "office0", "office1"}),
    (("toy", "office0", "room0", "office1"), {"toy", "office0"}),
    (("office0", "toy", "office1", "room0"), set()),
    (ORDER, set(ORDER)),
]


@pytest.mark.parametrize(("order", "untouched"), CHANGES, ids=lambda v: "-".join(v) if isinstance(v, tuple) else "")
def test_a_change_of_order_makes_exactly_what_depends_on_it_stale(sequence, order, untouched):
    before, after = dict(keys(sequence(*ORDER))), dict(keys(sequence(*order)))
    for scene in before.keys() & after.keys():
        changed = {stage for stage, key in after[scene].items() if before[scene][stage] != key}
        assert changed == (set() if scene in untouched else before[scene].keys() - BEFORE_TRAIN), scene


def test_scene_k_trains_on_revision_k_minus_one_and_the_first_on_none(sequence):
    found = chain(Planner(), sequence(*ORDER), LABELS)
    for place, plan in enumerate(found):
        read = {step.stage: step.inputs.get("basis") for step in plan.steps if step.stage in ("train", "cks")}
        earlier = found[place - 1].targets["cks"] if place else None
        assert read == {"train": earlier, "cks": earlier}
    assert [plan.title for plan in found[:2]] == [f"mine-1-toy@{LABELS}", f"mine-2-office0@{LABELS}"]


def ask(scene=None, basis="", settings=LABELS, sequence=None, ablation=""):
    return plans(scene=scene, sequence=sequence, settings=settings, ablation=ablation, basis=basis)


def test_a_scene_on_a_given_revision_is_trained_as_the_next_of_the_sequence(sequence):
    path = sequence("toy", "office0", "office1")
    *earlier, plan = ask("room0", f"{path}@2")
    as_third = chain(Planner(), sequence("toy", "office0", "room0", name="other"), LABELS)[2]
    assert plan.targets["train"] == as_third.targets["train"]
    assert plan.targets["evaluate"] == as_third.targets["evaluate"]
    assert plan.left_out["cks"] == "no sequence is named"
    assert plan.title == f"room0@{LABELS}+basis=mine@2"
    assert [found.asked for found in earlier] == [False, False]
    wanted = wanted_steps(plan, None, [*earlier, plan])
    stages = [step.stage for step in wanted]
    assert (stages.count("train"), stages.count("cks")) == (3, 2)
    assert (stages.count("evaluate"), stages.count("onnx")) == (1, 1)  # of the earlier scenes only what it needs
    assert ask("room0", path)[-1].title.endswith("basis=mine@3")  # the newest, where none is named
    only_train = wanted_steps(plan, "train", [*earlier, plan])
    assert [step.stage for step in only_train].count("cks") == 2
    assert checked_stage("evaluate", [*earlier, plan]) == "evaluate"


def test_without_a_basis_the_stage_is_left_out_and_said():
    (plan,) = ask("toy", settings="")
    assert "cks" not in plan.targets
    assert plan.left_out["cks"] == "no sequence is named"


def test_a_sequence_of_scenes_without_encoder_carries_nothing(sequence):
    for plan in chain(Planner(), sequence("toy", "office0"), ablation="no-tle"):
        assert plan.left_out["cks"] == "train.encoder is mlp: it has no attention weights"
        assert all("basis" not in step.inputs for step in plan.steps)


def test_settings_may_have_spaces_about_their_commas_and_are_given_once():
    wanted = {"train": {"steps": 5, "albo": False}, "teacher": {"scales": [0.5, 1.0]}}
    assert overrides("train.steps=5, train.albo = off ,teacher.scales=[0.5, 1.0]") == wanted
    with pytest.raises(ConfigError, match=r"train\.steps is given twice"):
        overrides("train.steps=5,train.albo=off,train.steps=6")
