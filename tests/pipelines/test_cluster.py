"""On a real Slurm: the bytes of one machine, a node that falls costs time alone, and little of it
is spent waiting.
"""

import csv
import os
import subprocess
import sys
import time

import pytest
from shared import ROOT
from slurm_nodes import MISSING, WHY, slurm
from soak.tiny import artifacts, contents, different, hidden

pytestmark = [
    pytest.mark.slow,
    pytest.mark.xdist_group("cluster"),
    pytest.mark.skipif(bool(MISSING), reason=WHY),
]
STUDY = """
title = "Toys"
about = "Runs of the toy scene that time nothing."
scenes = ["toy"]
seeds = {seeds}
baseline = "features-only"
budgets.steps = {budgets}

[settings]
sfm = {{ max_points = 200 }}
describe = {{ n_regions = 12 }}
train = {{ n_densify = 1, report_every = 6 }}
teacher = {{ kind = "labels" }}
evaluate = {{ timing_repeats = 0 }}

[variants.full]
[variants.features-only]
ablation = "features-only"
"""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with slurm(tmp_path_factory.mktemp("slurm")) as nodes:
        yield nodes


def studied(folder, work, on, cluster, **values):
    """A study under way in the store `work`."""
    folder.mkdir(exist_ok=True)
    (folder / "toys.toml").write_text(STUDY.format(**values))
    command = [
        sys.executable,
        "-P",
        "-m",
        "chebsplat.pipelines.cli",
        "study",
        folder / "toys.toml",
        "--on",
        on,
    ]
    command += ["--threads", "1", "--out", folder / on]
    command += ["--cores", "3"] if on == "local" else []  # the cluster has three
    environment = os.environ | cluster.environment | {"CHEBSPLAT_WORK": str(work)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=ROOT, env=environment, text=True, **pipes)


def finished(process):
    """Seconds until a study has ended well."""
    began = time.monotonic()
    _, error = process.communicate()
    assert process.returncode == 0, error
    return time.monotonic() - began


def test_a_node_that_falls_costs_time_alone(cluster, tmp_path):
    values, whole, work = {"seeds": [0], "budgets": [12]}, tmp_path / "local", tmp_path / "work"
    finished(studied(tmp_path / "study", whole, "local", cluster, **values))
    running = studied(tmp_path / "study", work, "slurm", cluster, **values)
    fallen = None
    try:
        while fallen is None:  # until a node trains
            assert running.poll() is None, running.communicate()
            time.sleep(0.05)
            for half in work.glob("store/train/.tmp-*"):
                key = half.name.split("-")[1]
                fallen = cluster.node_of(key)
        cluster.fell(fallen)
        cluster.wait_for(
            lambda: cluster.ask("squeue", "--noheader", "--states=PD", "--format=%i"),
            "slurmctld",
            60,
        )
        for number in cluster.ask("squeue", "--noheader", "--states=PD", "--format=%i"):
            # Slurm would wait two minutes
            cluster.ask("scontrol", "update", f"JobId={number}", "StartTime=now")
        finished(running)
    finally:
        running.kill()
        if fallen is not None:
            cluster.start_node(fallen)
    assert different(work, contents(whole), finished=True) == ""
    assert not hidden(work)
    cluster.wait_for(lambda: cluster.states().count("idle") == 3, "slurmctld", 60)


def test_sixty_steps_give_the_bytes_of_one_machine_and_are_timed(cluster, tmp_path):
    values, seconds = {"seeds": [0, 1], "budgets": [12, 18, 24]}, {}
    for on in ("local", "slurm"):
        seconds[on] = finished(studied(tmp_path / "study", tmp_path / on, on, cluster, **values))
    n_jobs = len(artifacts(tmp_path / "slurm"))
    assert n_jobs >= 60
    assert different(tmp_path / "slurm", contents(tmp_path / "local"), finished=True) == ""
    rows = [["steps", *seconds, "ratio"], [n_jobs, *(f"{s:.1f}" for s in seconds.values())]]
    rows[1].append(f"{seconds['slurm'] / seconds['local']:.2f}")
    (ROOT / "build").mkdir(exist_ok=True)
    with open(ROOT / "build/cluster.csv", "w", newline="") as file:
        csv.writer(file).writerows(rows)


def test_a_run_that_is_stopped_or_killed_takes_its_jobs_with_it(cluster, tmp_path):
    for how in ("terminate", "kill"):
        work = tmp_path / how
        running = studied(tmp_path / "study", work, "slurm", cluster, seeds=[0], budgets=[12])
        while not list(work.glob("store/*/.tmp-*")):
            assert running.poll() is None, running.communicate()
            time.sleep(0.05)
        getattr(running, how)()
        running.communicate()
        cluster.wait_for(lambda: not cluster.ask("squeue", "--noheader"), "slurmctld", 90)
        assert not hidden(work)
        contents(work)
