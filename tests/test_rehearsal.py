"""The first training on a machine has its kernels compiled side by side; later ones lose no time over it."""

import fcntl
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from shared import ROOT

from chebsplat.kernels import jit
from chebsplat.pipelines import rehearsal

TRAINS = """
import sys
sys.path.insert(0, sys.argv[1])
from benchmarks.stability.training import tiny_trainer
from chebsplat.kernels import jit
from chebsplat.pipelines import rehearsal
if __name__ == "__main__":
    with rehearsal.rehearsed(2, True):
        here = jit.compilation.kernels
        made = tiny_trainer(steps=30, encoder="points", weight_depth=1.0, depth_every=2)
        for _ in made.steps():
            pass
        made.finish()
        assert jit.compilation.kernels == here, jit.compilation.kernels - here
    print(here, sorted(path.name for path in jit.FOLDER.iterdir() if path.is_file()))
"""


@pytest.mark.slow  # everything is compiled twice
def test_a_training_finds_all_its_kernels_compiled(tmp_path):
    (tmp_path / "trains.py").write_text(TRAINS)
    command = [sys.executable, str(tmp_path / "trains.py"), str(ROOT)]
    environment = os.environ | {"CHEBSPLAT_CACHE": str(tmp_path / "kept")}
    first, second = (subprocess.run(command, capture_output=True, text=True, env=environment) for _ in range(2))
    assert first.returncode == 0, first.stderr
    assert int(first.stdout.split()[0]) > 50 and "rehearsed-descriptors" in first.stdout
    assert second.stdout.split()[0] == "0", second.stderr


def kept(folder, *parts):
    for part in parts:
        (folder / f"rehearsed-{part.__name__}").touch()


def test_nothing_is_rehearsed_twice_nor_on_one_thread_nor_where_nothing_is_kept(tmp_path, monkeypatch):
    def rasterizer():
        raise AssertionError("rehearsed")

    monkeypatch.setattr(rehearsal, "NEEDED", (rasterizer, *rehearsal.NEEDED[1:]))
    monkeypatch.setattr(rehearsal, "rasterizer", rasterizer)
    monkeypatch.setattr(jit, "FOLDER", tmp_path)
    with rehearsal.rehearsed(1, True):
        pass
    kept(tmp_path, *rehearsal.NEEDED)
    with rehearsal.rehearsed(2, False):
        pass
    kept(tmp_path, *rehearsal.SEMANTIC)
    with rehearsal.rehearsed(2, True):
        pass
    monkeypatch.setattr(jit, "FOLDER", None)
    with rehearsal.rehearsed(2, True):
        pass


def test_what_another_process_rehearses_is_waited_for(tmp_path, monkeypatch):
    def rasterizer():
        raise AssertionError("rehearsed")

    monkeypatch.setattr(jit, "FOLDER", tmp_path)
    with open(tmp_path / "rehearsed-rasterizer.lock", "w") as held, ThreadPoolExecutor(1) as pool:
        fcntl.flock(held, fcntl.LOCK_EX)
        waiting = pool.submit(rehearsal.once, rasterizer)
        with pytest.raises(TimeoutError):
            waiting.result(0.2)
        kept(tmp_path, rasterizer)
        fcntl.flock(held, fcntl.LOCK_UN)
        waiting.result(10)


def test_what_compiles_beside_a_training_ends_with_it(tmp_path, monkeypatch):
    started = []

    def failing():
        from multiprocessing import active_children

        started.extend(active_children())
        raise KeyboardInterrupt

    monkeypatch.setattr(rehearsal, "rasterizer", failing)
    monkeypatch.setattr(jit, "FOLDER", tmp_path)
    with pytest.raises(KeyboardInterrupt), rehearsal.rehearsed(2, True):
        pass
    assert len(started) == 2 and not any(process.is_alive() for process in started)
    assert not rehearsal.is_kept(rehearsal.NEEDED[0])
