"""Sets of lessons: processes add at once, killed ones spoil nothing, and a scene stays with what it
is pinned to.
"""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
from shared import ROOT, key_of

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import artifact
from chebsplat.formats.knowledge import SHIPPED
from chebsplat.formats.lesson import SCHEMA, Lesson, write_lesson
from chebsplat.formats.manifest import Manifest
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.planning.sequences import plan_relearning, plan_sequence
from chebsplat.pipelines.work import heads, store
from chebsplat.stages.registry import STAGES

START = artifact.read_manifest(SHIPPED).key


@pytest.fixture(autouse=True)
def work(quick_plans):
    return quick_plans


def made(name, **notes):
    """A lesson in the store, as a run leaves it."""
    path = store.artifact_path("learn", key_of(name))
    with artifact.publish(path, Manifest(SCHEMA, key_of(name), "learn")) as tmp:
        write_lesson(
            tmp, Lesson((np.eye(3), np.ones((3, 2)), 1.0), {"scene": name, "given": True} | notes)
        )
    return path


def add(name, capture):
    heads.add("rooms", made(name), capture, START, name)
    return key_of(name)


ADDING = """
import sys
from pathlib import Path
from chebsplat.pipelines.work import heads
for path in map(Path, sys.argv[1:]):
    heads.add("rooms", path, path.name, "start", path.name)
    print(path.name, flush=True)
"""


def test_processes_that_add_at_once_and_are_killed_leave_a_whole_set(work):
    paths = [made(f"lesson {k}") for k in range(100)]
    # each half its neighbour's
    shares = [[paths[(12 * worker + k) % 100] for k in range(25)] for worker in range(8)]

    def begun(share):
        command = [sys.executable, "-c", ADDING, *map(str, share)]
        return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)

    def held():
        found = heads.members("rooms").keys()
        for key in found:
            artifact.verify(heads.folder("rooms") / key, SCHEMA)
        return found

    running = [begun(share) for share in shares]
    for process, after in zip(running, (1, 7, 13), strict=False):
        for _ in range(after):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
    assert [process.communicate() and process.returncode for process in running] == [
        -signal.SIGKILL
    ] * 3 + [0] * 5
    named = [{path.name for path in share} for share in shares]
    assert set().union(*named[3:]) <= held() <= set().union(*named)
    for process in list(map(begun, shares[:3])):
        process.communicate()
    assert held() == set().union(*named)


def test_what_a_kill_leaves_between_record_and_lesson_is_no_member_and_is_added_again():
    key = add("a", "photos a")
    (heads.folder("rooms") / key / "artifact.json").unlink()
    assert heads.members("rooms") == {}
    add("a", "photos a")
    assert heads.members("rooms").keys() == {key}
    heads.add("rooms", made("nothing", none="no surface"), "photos b", START, "b")
    assert heads.members("rooms").keys() == {key}


def recalled(scene, settings="", **options):
    """Keys of the lessons that a scene starts from; the key of its last step but the report."""
    steps = {
        step.stage: step for step in Planner(running=True, **options).plan(scene, settings).steps
    }
    lessons = steps["recall"].inputs.keys() - {"start"} if "recall" in steps else set()
    return {role.removeprefix("lesson-") for role in lessons}, steps["refine"].key


def test_a_pin_holds_until_newer_lessons_are_asked_for_and_none_is_of_the_same_photos(monkeypatch):
    days = iter((1, 3, 2, 4, 5, 6))
    monkeypatch.setattr(heads, "now", lambda: f"2026-01-0{next(days)}")
    _, late, _ = (add(name, "photos a") for name in ("a", "a again", "a between"))
    heads.add(
        "rooms", made("own"), Planner().plan("office0").lesson.capture, START, "office0, otherwise"
    )
    heads.add("rooms", made("of another encoder"), "photos z", key_of("another"), "z")
    assert recalled("office0")[0] == {late}
    pin = store.work() / "office0" / heads.PIN
    assert list(json.loads(pin.read_text()).values()) == [[late]]
    before = recalled("office0", "refine.smooth=on"), recalled("office0", "describe.bandwidth=0.8")
    b = add("b", "photos b")
    after = recalled("office0", "refine.smooth=on"), recalled("office0", "describe.bandwidth=0.8")
    # ablations of one capture start from the same, whatever was learned between them
    assert before == after
    assert recalled("office1")[0] == {late, b, key_of("own")}
    assert recalled("office0", newer=True)[0] == recalled("office0")[0] == {late, b}
    assert recalled("office0", "knowledge.start=other")[0] == set()


def test_a_forgotten_lesson_that_a_pin_names_is_refused_with_the_remedy(work):
    a, b = add("a", "photos a"), add("b", "photos b")
    assert recalled("office0")[0] == {a, b}
    with pytest.raises(ConfigError, match=f"rooms has no lesson {a[:-1]}; did you mean {a}"):
        heads.forget("rooms", a[:-1])
    heads.forget("rooms", a)
    assert not (heads.folder("rooms") / a).exists()
    add("a", "photos a")  # a run of the scene does not bring it back
    assert heads.members("rooms").keys() == {b}
    store.remove(store.artifact_path("learn", a))
    with pytest.raises(
        ConfigError,
        match=f"office0 is pinned to the lesson {a}, which rooms has no more; add newer=1",
    ):
        recalled("office0")
    assert recalled("office0", newer=True)[0] == {b}
    store.remove(store.artifact_path("learn", b))
    assert recalled("office0")[0] == {b}  # the set's copy
    assert store.is_fresh(store.artifact_path("learn", b))


def test_damaged_pins_and_records_are_refused_by_name():
    a = add("a", "photos a")
    recalled("office0")
    for path, remedy in ((store.work() / "office0" / heads.PIN, "pins the scene anew"),
                         (heads.folder("rooms") / f"{a}.json",
                          "adds? its lesson|adds it again")):  # fmt: skip
        good = path.read_text()
        for bad in ("{", "[]", '{"a": 1}'):
            path.write_text(bad)
            with pytest.raises(InputError, match=f"{path.name}.*({remedy})"):
                recalled("office0", newer=path.name != heads.PIN)
        path.write_text(good)
    assert recalled("office0")[0] == {a}


def test_scenes_of_a_sequence_start_from_the_lessons_of_those_before(tmp_path):
    kept = add("a", "photos a")
    heads.add(
        "rooms", made("office0 before"), Planner().plan("office0").lesson.capture, START, "office0"
    )
    (tmp_path / "mine.toml").write_text('scenes = ["office0", "office1", "office0", "room0"]')
    plans = plan_sequence(Planner(running=True), str(tmp_path / "mine.toml"))
    found = [
        {role for step in plan.steps if step.stage == "recall" for role in step.inputs}
        for plan in plans
    ]
    first, second, third, _ = (f"lesson-{plan.lesson.path.name}" for plan in plans)
    assert first == third
    kept = f"lesson-{kept}"
    assert found == [
        {"start", kept},
        {"start", kept, first},
        {"start", kept, second},
        {"start", kept, first, second},
    ]


def test_a_set_is_learned_again_by_another_encoder_from_what_the_store_holds(capsys):
    config = {"scene": {"name": "a"}}
    inputs = {
        role: {"key": key_of(of), "schema": "s/1"} for role, of in STAGES["learn"].roles.items()
    }
    for of in STAGES["learn"].roles.values():
        with artifact.publish(
            store.artifact_path(of, key_of(of)), Manifest(STAGES[of].schema, key_of(of), of)
        ):
            pass
    path = store.artifact_path("learn", key_of("a"))
    with artifact.publish(path, Manifest(SCHEMA, key_of("a"), "learn", inputs, config)) as tmp:
        write_lesson(tmp, Lesson((np.eye(3), np.ones((3, 2)), 1.0), {"scene": "a"}))
    heads.add("rooms", path, "photos a", key_of("older"), "a")
    add("b", "photos b")  # by the encoder that ships: stays
    (plan,) = plan_relearning(Planner(running=True), "rooms")
    assert [step.stage for step in plan.steps] == ["encode", "learn"]
    assert plan.steps[1].inputs["encoding"] == plan.steps[0].path
    assert (plan.lesson.capture, plan.lesson.start) == ("photos a", START)
    store.remove(store.artifact_path("describe", key_of("describe")))
    assert plan_relearning(Planner(running=True), "rooms") == []
    assert "a: its artifacts are gone" in capsys.readouterr().err
