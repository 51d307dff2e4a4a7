"""Scenes in order: what each reads of the one before, and what a change of the order makes
stale.
"""

import pytest
from shared import ROOT

from chebsplat.errors import ConfigError
from chebsplat.pipelines.planning.plan import Planner, overrides
from chebsplat.pipelines.planning.sequences import plan_sequence, scenes_of
from chebsplat.pipelines.running.run import needed_steps

BEFORE_TRAIN = {"ingest", "sfm", "teacher", "agree"}
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
    found = plan_sequence(planner, path, LABELS, "paper")
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


@pytest.mark.parametrize(
    ("order", "untouched"), CHANGES, ids=lambda v: "-".join(v) if isinstance(v, tuple) else ""
)
def test_a_change_of_order_makes_exactly_what_depends_on_it_stale(sequence, order, untouched):
    before, after = dict(keys(sequence(*ORDER))), dict(keys(sequence(*order)))
    for scene in before.keys() & after.keys():
        changed = {stage for stage, key in after[scene].items() if before[scene][stage] != key}
        assert changed == (set() if scene in untouched else before[scene].keys() - BEFORE_TRAIN), (
            scene
        )


def test_scene_k_reads_the_training_of_scene_k_minus_one_and_the_first_none(sequence):
    found = plan_sequence(Planner(), sequence(*ORDER), LABELS, "paper")
    for place, plan in enumerate(found):
        read = {
            step.stage: step.inputs["earlier"] for step in plan.steps if "earlier" in step.inputs
        }
        assert read == ({"train": found[place - 1].targets["train"]} if place else {})
    assert [plan.title for plan in found[:2]] == [
        f"mine-1-toy@paper+{LABELS}",
        f"mine-2-office0@paper+{LABELS}",
    ]
    stages = [step.stage for step in needed_steps(found[2], "train", found)]
    assert (stages.count("train"), stages.count("evaluate")) == (3, 0)


def test_the_first_scene_of_a_sequence_is_the_scene_alone(sequence):
    (first, _), alone = (
        plan_sequence(Planner(), sequence("toy", "office0"), "", "paper"),
        Planner().plan("toy", "", "paper"),
    )
    assert first.targets == alone.targets


def test_settings_may_have_spaces_about_their_commas_and_are_given_once():
    wanted = {"train": {"steps": 5, "prune": False}, "teacher": {"scales": [0.5, 1.0]}}
    assert overrides("train.steps=5, train.prune = off ,teacher.scales=[0.5, 1.0]") == wanted
    with pytest.raises(ConfigError, match=r"train\.steps is given twice"):
        overrides("train.steps=5,train.prune=off,train.steps=6")
