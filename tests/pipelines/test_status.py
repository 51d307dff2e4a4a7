"""What is told of runs and of what they leave: states, ends of logs, ages, sizes."""

import json
import os
import re
import time

import pytest
from click.testing import CliRunner
from shared import finish

from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.manifest import measured_on
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.running import cluster, job
from chebsplat.pipelines.running.run import entry, plan_of
from chebsplat.pipelines.work import store
from chebsplat.pipelines.work.summary import as_taken, covisible, table

pytestmark = pytest.mark.usefixtures("quick_plans")


def told(*arguments):
    done = CliRunner().invoke(main, list(arguments))
    assert done.exit_code == 0, done.stderr
    return done.stdout


def test_status_tells_what_runs_waits_and_has_failed_with_the_end_of_its_log():
    plan = Planner(running=True).plan("toy")
    entries = {step.stage: entry(step, {}) | {"threads": 1} for step in plan.steps}
    with plan_of(list(entries.values())) as file:
        base = file.parent / cluster.name_of(entries["sfm"])
        base.with_suffix(".exit").write_text(job.CODE.format(4))
        base.with_suffix(".log").write_text("\n".join(f"line {k}" for k in range(9)))
        base = file.parent / cluster.name_of(entries["teacher"])
        base.with_suffix(".log").write_text("begun")
        plan.steps = [step for step in plan.steps if step.stage == "ingest"]
        finish(plan)
        elsewhere = store.lease(store.work(), cluster.name_of(entries["agree"]))
        elsewhere.write_text("filelock/2\npid=17\nhost=node7\nmode=lease\ntoken=0\nduration=60.0\n")
        began = time.time() - 42
        os.utime(file.parent / f"{elsewhere.name}.exit", (began, began))
        lines = told("status").splitlines()
        n_waiting = len(entries) - 3
        assert lines[0].endswith(f"1 done, 1 runs, {n_waiting} waits, 1 failed")
        assert any(
            line.split()[:2] == ["failed", "sfm"] and "exit code 4" in line for line in lines
        )
        assert "    line 8" in lines and "    line 3" not in lines
        assert re.search(r"\n  runs +agree +[0-9a-f]{16}  4\d s on node7\n", told("status"))
        assert "1 teacher" in lines[-1]
    lines = told("status").splitlines()
    assert ", over: " in lines[0] and f"{n_waiting - 1} not begun, 2 failed" in lines[0]
    assert any(line.split()[:2] == ["failed", "teacher"] and "killed" in line for line in lines)


def test_status_of_a_store_where_nothing_runs_says_so_and_of_a_damaged_plan_too():
    assert told("status") == ""
    folder = store.work() / ".plans/abc-1"
    folder.mkdir(parents=True)
    (folder / "plan.json").write_text("{")
    assert f"remove {folder}" in told("status")


def test_what_is_young_is_spared_by_the_clock_of_the_file_system():
    plan = Planner(running=True).plan("toy")
    finish(plan)
    old = plan.targets["sfm"] / "artifact.json"
    now = old.stat().st_mtime
    os.utime(old, (now - 8 * 86400, now - 8 * 86400))
    spared = told("clean-stale", "--keep-newer", "7d")
    assert str(plan.targets["sfm"]) in spared and "in 1 folders" in spared
    assert f"in {len(plan.steps)} folders" in told("clean-stale")
    told("clean-stale", "--keep-newer", "7d", "--yes")
    assert [step.stage for step in plan.steps if not step.fresh] == ["sfm"]
    wrong = CliRunner().invoke(main, ["clean-stale", "--keep-newer", "soon"])
    assert wrong.exit_code == 2 and "7d" in wrong.stderr


def test_scenes_that_nothing_was_added_to_for_long_are_given_up_with_what_they_alone_name():
    plans = [Planner(running=True).plan("toy", settings) for settings in ("", "train.steps=5")]
    for plan in plans:
        finish(plan)
        store.link(plan.title, plan.targets)
    for path in plans[0].targets.values():
        now = (path / "artifact.json").stat().st_mtime
        os.utime(path / "artifact.json", (now - 8 * 86400, now - 8 * 86400))
    assert told("clean-stale", "--older-than", "9d", "--yes").split()[-2:] == ["0", "folders"]
    listed = told("clean-stale", "--older-than", "7d")
    only = set(plans[0].targets.values()) - set(plans[1].targets.values())
    # the other one's are made of some of them, though they are as old
    assert 0 < len(only) < len(plans[0].steps)
    assert str(store.work() / "toy") in listed and f"in {len(only)} folders; yes=1" in listed
    told("clean-stale", "--older-than", "7d", "--yes")
    assert not (store.work() / "toy").exists() and (store.work() / plans[1].title).is_dir()
    assert not any(path.exists() for path in only) and all(
        path.exists() for path in plans[1].targets.values()
    )


def test_ls_counts_what_scenes_share_in_each_and_apart_what_is_one_s_alone():
    plans = [Planner(running=True).plan("toy", settings) for settings in ("", "train.steps=5")]
    for plan in plans:
        finish(plan)
        for step in plan.steps:
            if (
                "weight"
                not in (manifest := json.loads((step.path / "artifact.json").read_text()))["files"]
            ):
                (step.path / "weight").write_bytes(bytes(10**6))
                manifest["files"]["weight"] = {"bytes": 10**6, "sha256": "0" * 64}
                (step.path / "artifact.json").write_text(json.dumps(manifest))
        store.link(plan.title, {"report": plan.targets["report"]})
    heading, *rows = [line.split() for line in told("ls").splitlines()]
    assert {row[0] for row in rows} == {"toy", "toy@train.steps=5"}
    ((whole, alone),) = {(float(row[3]), float(row[4])) for row in rows}
    named, others = ({step.key for step in plan.steps} for plan in plans)
    assert heading[3:5] == ["MB", "alone"]
    assert (whole, alone) == (len(named), len(named - others))


def test_a_run_under_way_on_another_machine_keeps_what_it_makes_from_clean_stale(monkeypatch):
    plan = Planner(running=True).plan("toy")
    finish(plan)
    with plan_of([entry(step, {}) | {"threads": 1} for step in plan.steps]) as file:
        elsewhere = file.parent.with_name(file.parent.name.rpartition("-")[0] + "-999999999")
        os.rename(file.parent, elsewhere)
        os.rename(store.run_lease(file.parent), store.run_lease(elsewhere))
        assert store.list_unreferenced() == []
        os.rename(store.run_lease(elsewhere), store.run_lease(file.parent))
        assert len(store.list_unreferenced()) == len(plan.steps) + 1
    assert not store.holder(store.run_lease(file.parent))


@pytest.mark.xdist_group("toy")
def test_frames_a_second_of_a_finished_scene_name_the_machine_that_rendered_them(toy):
    manifest = read_manifest(toy["evaluate"])
    beside = {what: detail for what, _, detail in table(toy["evaluate"])}
    assert beside["frames/s"] == f"colour alone, measured on {measured_on(manifest)}"
    assert manifest.processes[0]["processor"] in beside["frames/s"]


@pytest.mark.parametrize(
    ("found", "told"),
    [
        ({"psnr": 22.04, "share": 0.61}, ("22.0 dB", "61% of the pixels with depth")),
        ({"psnr": 22.04, "share": 0.951}, ("", "")),
        (None, ("", "")),
    ],
)  # fmt: skip
def test_covisible_pixels_are_told_of_where_they_are_not_nearly_all(found, told):
    assert covisible({"image": {"covisible": found} if found else {}}) == told
    assert covisible(None) == ("", "")


def test_photos_as_taken_are_told_of_with_their_size():
    taken = {"psnr": 30.0, "ssim": 0.8512, "size": [1600, 900]}
    assert as_taken({"image": {"as_taken": taken}}) == "SSIM 0.851, 1600×900 pixels"
    assert as_taken(None) == as_taken({"image": {}}) == ""
