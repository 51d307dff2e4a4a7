"""What goes to a cluster: which steps together, what they ask for, and what is said where there is
no cluster.
"""

import os
import sys
import threading
from graphlib import TopologicalSorter

import pytest

from chebsplat.errors import ConfigError
from chebsplat.pipelines.planning import sequences
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.running import cluster, job
from chebsplat.pipelines.running import processes as children
from chebsplat.pipelines.running.run import device_of, entry, needed_steps, write_plan
from chebsplat.pipelines.studies.study import checked_study, expand, outstanding
from chebsplat.pipelines.work import leases, store
from chebsplat.stages.registry import STAGES

pytestmark = pytest.mark.usefixtures("quick_plans")


def entries_of(steps, device="cpu"):
    return [entry(step, {}, device) | {"threads": 2} for step in steps]


def jobs(entries, on="slurm"):
    """Stages of each job, none of which waits for one that waits for it."""
    stage_of = {item["key"]: item["stage"] for item in entries}
    made = cluster.jobs_of(entries, on)
    job_of = {key: name for name, one in made.items() for key in one["keys"]}
    by_path = {item["path"]: item["key"] for item in entries}
    waits = {name: set() for name in made}
    for item in entries:
        earlier = {
            job_of[by_path[path]]
            for path in (*item["inputs"].values(), *item["after"])
            if path in by_path
        }
        waits[job_of[item["key"]]] |= earlier - {job_of[item["key"]]}
    TopologicalSorter(waits).prepare()
    return sorted([stage_of[key] for key in one["keys"]] for one in made.values())


def test_on_one_machine_a_step_is_a_job():
    entries = entries_of(needed_steps(Planner().plan("office0"), None))
    assert jobs(entries, "local") == sorted([item["stage"]] for item in entries)


def test_steps_of_seconds_go_with_what_they_follow():
    toy = [["ingest", "sfm", "teacher", "agree"], ["train", "lift", "refine", "export", "evaluate"]]
    assert [
        some[:5] for some in jobs(entries_of(needed_steps(Planner().plan("toy"), None)))
    ] == sorted(toy)
    office = jobs(entries_of(needed_steps(Planner().plan("office0"), None)))
    assert ["ingest", "sfm", "describe", "encode", "onnx"] in office and ["train"] in office
    assert ["teacher", "agree", "learn"] in office
    assert ["lift", "refine", "export", "evaluate", "report"] in office


@pytest.mark.parametrize("ablation", ["paper", ""])
def test_no_job_of_a_sequence_or_of_what_is_half_done_waits_for_itself(tmp_path, ablation):
    (tmp_path / "mine.toml").write_text('scenes = ["toy", "office0", "toy", "office0"]')
    plans = sequences.plan_sequence(
        Planner(), str(tmp_path / "mine.toml"), "knowledge.start=rooms", ablation
    )
    steps = {step.key: step for plan in plans for step in plan.steps}
    entries = entries_of(steps.values())
    assert len(jobs(entries)) < len(entries) / 2
    for missing in STAGES:
        jobs([item for item in entries if item["stage"] != missing])


def test_a_study_of_short_trainings_is_one_job_a_run():
    values = {"title": "T", "about": "A", "scenes": ["toy"], "seeds": [0, 1], "baseline": "less"}
    values |= {"variants": {"full": {}, "less": {"ablation": "features-only"}}}
    found = jobs(entries_of(outstanding(expand(checked_study(values, "study")))))
    assert len(found) == 1 + 4


def test_jobs_ask_for_the_most_memory_of_a_step_the_time_of_all_and_a_gpu_where_one_computes():
    made = cluster.jobs_of(
        entries_of(needed_steps(Planner(device="cuda").plan("office0"), None), "cuda"), "slurm"
    )
    train = next(one for name, one in made.items() if name.startswith("train"))
    assert train["gpus"] == 1 and train["mem_mb"] == STAGES["train"].mem_mb
    assert train["minutes"] >= 5 * 239 / 60  # five times what 3000 steps took at most
    first = next(one for name, one in made.items() if name.startswith("ingest"))
    assert first["gpus"] == 0
    stages = ("ingest", "sfm", "describe", "encode", "onnx")
    assert first["minutes"] == sum(STAGES[stage].minutes for stage in stages)


def test_a_gpu_of_nodes_is_not_looked_for_where_jobs_are_submitted(monkeypatch):
    monkeypatch.setattr("chebsplat.stages.runtime.device.missing", lambda: "no GPU answers")
    assert device_of("cuda", "slurm") == "cuda"
    with pytest.raises(ConfigError, match="no GPU answers"):
        device_of("cuda")


def test_another_attempt_leaves_what_settings_or_data_do_not_allow_as_it_is(monkeypatch):
    items = [entry(step, {}) for step in Planner().plan("toy").steps]
    plan = write_plan(store.work() / ".plans/abc", items, {})
    tried = []
    monkeypatch.setattr(job, "make", lambda plan, key: tried.append(key))
    for code, item in zip((2, 3, 4, 1, 137, 0), items, strict=False):
        (plan.parent / f"{cluster.name_of(item)}.exit").write_text(job.CODE.format(code))
        assert job.run(plan, item["key"], again=True) == (code if code in (2, 3, 4) else 0)
    assert tried == [item["key"] for item in items[3:6]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("jobs: 3", "names no executor"),
        ("executor: [", "cannot be read as YAML"),
        ("executor: elsewhere", "plugin for elsewhere is not installed"),
    ],
)
def test_a_profile_that_cannot_be_used_is_named(tmp_path, text, message):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/config.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        cluster.checked(f"{tmp_path}/mine/")
    with pytest.raises(ConfigError, match="local, slurm, or a folder"):
        cluster.checked("mine")


def test_without_the_plugin_or_slurm_a_run_there_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, cluster.PLUGIN, None)
    with pytest.raises(ConfigError, match=r"on=slurm needs the extra `slurm`: .*\[slurm\]"):
        cluster.checked("slurm")
    monkeypatch.setattr(cluster, "require", lambda *_: None)
    monkeypatch.setattr(cluster.shutil, "which", lambda name: None)
    with pytest.raises(ConfigError, match="no sbatch on the PATH"):
        cluster.checked("slurm")
    assert cluster.checked("local") == "local"


def test_a_job_on_a_node_stops_when_its_run_lets_go(monkeypatch, tmp_path):
    plan, told = store.work() / ".plans/abc-1/plan.json", threading.Event()
    monkeypatch.setattr(leases, "EVERY", 0.05)
    monkeypatch.setattr(cluster, "end_itself", told.set)
    with leases.hold(store.run_lease(plan.parent)):
        cluster.watch_run(plan)
        assert not told.wait(0.3)
    assert told.wait(5)


def _step(arguments):
    name, code, file = arguments
    with open(file, "a") as told:
        told.write(f"{name} {os.getpid()} {'torch' in sys.modules}\n")
    if code == "9":
        os.kill(os.getpid(), 9)
    sys.exit(int(code))


@pytest.mark.parametrize(("codes", "code"), [("00", 0), ("03", 3), ("30", 3), ("09", 137)])
def test_steps_of_a_job_have_processes_of_their_own_and_end_with_the_first_that_fails(
    codes, code, tmp_path
):
    told = tmp_path / "told"
    calls = [[f"step{k}", one, str(told)] for k, one in enumerate(codes)]
    assert children.run_in_turn(_step, calls) == code
    lines = [line.split() for line in told.read_text().splitlines()]
    assert [name for name, _, _ in lines] == ["step0", "step1"][: 1 if codes[0] != "0" else 2]
    assert len({process for _, process, _ in lines} | {str(os.getpid())}) == len(lines) + 1
    assert {there for _, _, there in lines} == {"True"}  # imported before the step was
