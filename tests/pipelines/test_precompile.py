"""The first training on a machine has its kernels compiled side by side; later ones lose no time
over it.
"""

import fcntl
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from shared import ROOT

from chebsplat.kernels import jit
from chebsplat.pipelines.running import precompile

TRAINS = """
import sys
sys.path.insert(0, sys.argv[1])
from benchmarks.stability.training import tiny_trainer
from chebsplat.kernels import jit
from chebsplat.pipelines.running import precompile
if __name__ == "__main__":
    with precompile.precompile(2, True):
        made = tiny_trainer(steps=30, weight_depth=1.0, depth_every=2)
        for _ in made.steps():
            pass
        made.finish()
        assert jit.compilation.kernels == 0, jit.compilation.kernels
    print(sorted(path.name for path in jit.FOLDER.iterdir() if path.is_file()))
"""


@pytest.mark.slow  # everything is compiled
def test_a_training_finds_all_its_kernels_compiled(tmp_path):
    (tmp_path / "trains.py").write_text(TRAINS)
    command = [sys.executable, str(tmp_path / "trains.py"), str(ROOT)]
    environment = os.environ | {"CHEBSPLAT_CACHE": str(tmp_path / "kept")}
    for _ in range(2):
        ran = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert ran.returncode == 0 and "rehearsed-descriptors" in ran.stdout, ran.stderr


def kept(folder, *parts):
    for part in parts:
        (folder / f"rehearsed-{part.__name__}").touch()


def test_nothing_is_rehearsed_twice_nor_on_one_thread_nor_where_nothing_is_kept(
    tmp_path, monkeypatch
):
    def rasterizer():
        raise AssertionError("rehearsed")

    monkeypatch.setattr(precompile, "NEEDED", (rasterizer, *precompile.NEEDED[1:]))
    monkeypatch.setattr(precompile, "rasterizer", rasterizer)
    monkeypatch.setattr(jit, "FOLDER", tmp_path)
    with precompile.precompile(1, True):
        pass
    kept(tmp_path, *precompile.NEEDED)
    with precompile.precompile(2, False):
        pass
    kept(tmp_path, *precompile.SEMANTIC)
    with precompile.precompile(2, True):
        pass
    monkeypatch.setattr(jit, "FOLDER", None)
    with precompile.precompile(2, True):
        pass


def test_what_another_process_rehearses_is_waited_for(tmp_path, monkeypatch):
    def rasterizer():
        raise AssertionError("rehearsed")

    monkeypatch.setattr(jit, "FOLDER", tmp_path)
    with open(tmp_path / "rehearsed-rasterizer.lock", "w") as held, ThreadPoolExecutor(1) as pool:
        fcntl.flock(held, fcntl.LOCK_EX)
        waiting = pool.submit(precompile.compile_once, rasterizer)
        with pytest.raises(TimeoutError):
            waiting.result(0.2)
        kept(tmp_path, rasterizer)
        fcntl.flock(held, fcntl.LOCK_UN)
        waiting.result(10)


BREAKS_OFF = """
import os, signal, sys, time
from chebsplat.kernels import jit
from chebsplat.pipelines.running import precompile
if __name__ == "__main__":
    lock = jit.FOLDER / "rehearsed-pause.lock"
    try:
        with precompile.compiler_process([signal.pause]) as process:
            until = time.monotonic() + 60
            while time.monotonic() < until and not (
                lock.exists() and precompile.is_locked(signal.pause)
            ):
                time.sleep(0.05)
            print(lock, process.is_alive(), flush=True)
            if sys.argv[1] == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        print(process.is_alive(), precompile.is_compiled(signal.pause))
"""


@pytest.mark.parametrize("how", ["stopped", "killed"])
def test_what_compiles_beside_a_training_ends_with_it(how, tmp_path):
    (tmp_path / "breaks_off.py").write_text(BREAKS_OFF)
    command = [sys.executable, str(tmp_path / "breaks_off.py"), how]
    environment = os.environ | {"CHEBSPLAT_CACHE": str(tmp_path / "kept")}
    ran = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    )
    lock, *rest = ran.stdout.split()
    assert rest == (["True"] if how == "killed" else ["True", "False", "False"])
    until = time.monotonic() + 5
    with open(lock, "w") as held:
        while True:  # the lock goes with the process that held it
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                assert time.monotonic() < until
                time.sleep(0.05)
