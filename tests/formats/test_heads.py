"""A HEAD that many processes move loses nothing, shows nothing half made, and needs no repair after a kill."""

import itertools
import os
import random
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from shared import ROOT, gaussian_parameters, key_of

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats import artifact, heads
from chebsplat.formats.basis import Basis, read_basis, read_lineage, write_basis
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.manifest import Manifest
from chebsplat.pipelines.bases import revisions
from chebsplat.pipelines.work import store
from chebsplat.shape.encoder import RegionEncoder
from chebsplat.stages import cks

COUNTING = """
import sys
from hashlib import sha256
from pathlib import Path
from chebsplat.formats import artifact, heads
from chebsplat.formats.basis import SCHEMA, Basis, read_lineage, write_basis
from chebsplat.formats.manifest import Manifest

root, who = Path(sys.argv[1]), sys.argv[2]
for number in range(int(sys.argv[3])):
    name = f"{who}-{number}"

    def build(head):
        lineage = [] if head is None else read_lineage(head)
        if name in {entry["gaussians"] for entry in lineage}:
            return None
        out = root / "store/cks" / sha256(f"{len(lineage)} {name}".encode()).hexdigest()[:16]
        with artifact.publish(out, Manifest(SCHEMA, out.name, "cks")) as tmp:
            write_basis(tmp, Basis({}, {}, [*lineage, {"scene": who, "gaussians": name, "spread": 0.0, "maps": {}}]))
        return out

    heads.extend(root / "basis-shared", build)
"""
# As COUNTING, where the file system knows no locks.
LOCKLESS = (
    """
import fcntl

def refused(*_):
    raise OSError("no locks here")

fcntl.flock = fcntl.lockf = refused
"""
    + COUNTING
)


def race(script, root, n_processes, n_updates, n_kills, pause, watch):
    """Run so many processes, killing a random one now and then, and starting it again; returns how many were killed."""
    environment = os.environ | {"CHEBSPLAT_WORK": str(root), "OMP_NUM_THREADS": "1"}

    def start(who):
        command = [sys.executable, "-c", script, str(root), str(who), str(n_updates)]
        return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

    running, rng, killed = {who: start(who) for who in range(n_processes)}, random.Random(0), 0
    while running:
        time.sleep(rng.uniform(0, pause))
        watch()
        for who, process in list(running.items()):
            if process.poll() is not None:
                _, error = process.communicate()
                assert process.returncode == 0, error.decode()
                del running[who]
        if running and killed < n_kills:
            who = rng.choice(sorted(running))
            running[who].kill()
            running[who].communicate()
            running[who] = start(who)
            killed += 1
    return killed


def nothing_is_lost(root, n_processes, n_updates, name=str):
    """All revisions, each the continuation of the one before, each update in them once."""
    found = heads.revisions(root / "basis-shared")
    assert len(found) == n_processes * n_updates
    lineages = [read_lineage(path) for path in found]
    assert all(later[:-1] == earlier for earlier, later in itertools.pairwise(lineages))
    names = [entry["gaussians"] for entry in lineages[-1]]
    assert sorted(names) == sorted(name(f"{who}-{k}") for who in range(n_processes) for k in range(n_updates))
    return found


def read_all(root):
    for path in heads.revisions(root / "basis-shared"):
        artifact.verify(path)


def test_processes_that_are_killed_lose_no_update_and_leave_no_half_revision(tmp_path):
    killed = race(COUNTING, tmp_path, 4, 6, n_kills=8, pause=0.25, watch=lambda: read_all(tmp_path))
    assert killed >= 1
    nothing_is_lost(tmp_path, 4, 6)


@pytest.mark.slow
def test_eight_hundred_updates_without_locks_of_the_file_system_by_killed_processes_are_all_there(tmp_path):
    def newest():
        if (tmp_path / "basis-shared").is_dir():
            count = len(os.listdir(tmp_path / "basis-shared"))
            artifact.verify(tmp_path / f"basis-shared/{count}") if count else None

    killed = race(LOCKLESS, tmp_path, 8, 100, n_kills=24, pause=2.0, watch=newest)
    assert killed >= 8
    nothing_is_lost(tmp_path, 8, 100)


def trained(path, key, seed):
    """A checkpoint whose encoder is random and its linear maps of rank 1, so that many scenes have news."""
    torch.manual_seed(seed)
    encoder = RegionEncoder(4, 3, width=32, n_layers=1)
    with torch.no_grad():
        for W in encoder.linear_maps().values():
            W.copy_(torch.randn(len(W), 1) @ torch.randn(1, W.shape[1]))
    modules = {f"shape.encoder.{name}": value.numpy() for name, value in encoder.state_dict().items()}
    notes = {"encoder": {"n_inputs": 4, "n_channels": 3} | encoder.settings}
    cameras = Cameras(["a"], np.eye(3)[None], np.eye(4)[None], 5, 4)
    config = {"describe": {}, "train": {}}
    with artifact.publish(path, Manifest(Gaussians.SCHEMA, key, "train", config=config)) as tmp:
        Gaussians(gaussian_parameters(), cameras, modules, notes=notes).write(tmp)
    return path


@pytest.fixture
def work(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path))
    monkeypatch.delenv("REPLICA_ROOT", raising=False)
    monkeypatch.chdir(ROOT)
    return tmp_path


def test_a_head_grows_by_scenes_and_a_scene_it_knows_adds_nothing(work):
    for seed in range(3):
        found = revisions.extend("shared", trained(work / f"trained/{seed}", key_of(seed), seed), f"room{seed}")
        assert len(found) == seed + 1
    again = revisions.extend("shared", work / "trained/1", "room1")
    assert again == found
    assert revisions.revisions("shared@2") == found[:2]
    assert {basis.shape[1] for basis in read_basis(found[-1]).bases.values()} == {3}
    assert [entry["scene"] for entry in read_lineage(found[-1])] == ["room0", "room1", "room2"]
    assert revisions.head_names() == ["shared"]
    assert store.unnamed() == []  # its links keep its artifacts, and its plans are gone
    with pytest.raises(ConfigError, match="has 3 revisions"):
        revisions.revisions("shared@4")
    with pytest.raises(ConfigError, match="did you mean shared"):
        revisions.revisions("shard")
    for name in ("offices", "a/b", "a@1", ""):
        with pytest.raises(ConfigError, match="cannot be called"):
            revisions.extend(name, work / "trained/0", "room0")


def test_a_head_whose_stage_fails_raises_its_error_and_stays_as_it_is(work, monkeypatch):
    def fail(job):
        raise DataFailure("no column is left")

    monkeypatch.setattr(cks, "run", fail)
    with pytest.raises(DataFailure, match="no column is left"):
        revisions.extend("shared", trained(work / "trained/0", key_of(0), 0), "room0")
    assert revisions.head_names() == []
    assert not list((work / ".plans").iterdir())


def test_a_head_moves_only_from_the_revision_that_was_read(tmp_path):
    first, second = (tmp_path / key_of(name) for name in "ab")
    for path in (first, second):
        with artifact.publish(path, Manifest("chebsplat.basis/3", path.name, "cks")) as tmp:
            write_basis(tmp, Basis({}, {}, []))
    folder = tmp_path / "basis-x"
    assert heads.advance(folder, 0, first)
    assert not heads.advance(folder, 0, second)
    assert heads.revisions(folder) == [first]
    assert heads.advance(folder, 1, second)
    with pytest.raises(InputError, match="missing"):
        heads.advance(folder, 2, tmp_path / "nothing")
    (folder / "1").unlink()
    with pytest.raises(InputError, match="no finished revision"):
        heads.revisions(folder)
