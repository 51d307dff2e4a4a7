"""Kernels are compiled with a word on it, kept where the user says, and a disk that takes nothing
costs no run.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from soak.disk import namespace

import chebsplat

PROGRAM = """
import logging, sys
logging.basicConfig(stream=sys.stderr, format="%(message)s")
logging.getLogger("chebsplat").setLevel("INFO")
from chebsplat.kernels import jit
from pathlib import Path
sys.path.insert(0, str(Path(sys.argv[1]).parent))
from chebsplat_kernels_of_a_test import double
print(double(3), jit.compilation.kernels, jit.FOLDER)
"""

KERNEL = """
from chebsplat.kernels.jit import serial
@serial
def double(x):
    return 2 * x
"""


def run(folder, mount=(), **environment):
    names = ("NUMBA_CACHE_DIR", "CHEBSPLAT_CACHE", "CHEBSPLAT_WORK", "XDG_CACHE_HOME")
    env = {name: value for name, value in os.environ.items() if name not in names} | environment
    module = folder / "chebsplat_kernels_of_a_test.py"
    if not module.exists():
        module.write_text(KERNEL)
    command = [*mount, sys.executable, "-P", "-c", PROGRAM, module]
    return subprocess.run(command, capture_output=True, text=True, env=env)


def test_kernels_are_kept_where_the_user_says_and_compiled_once_or_when_they_are_damaged(tmp_path):
    first, second = (run(tmp_path, CHEBSPLAT_CACHE=str(tmp_path / "kept")) for _ in range(2))
    (file,) = tmp_path.glob("kept/*/*/*.nbc")
    file.write_bytes(file.read_bytes()[:100])
    third = run(tmp_path, CHEBSPLAT_CACHE=str(tmp_path / "kept"))
    assert first.stdout.startswith(f"6 1 {tmp_path / 'kept'}"), first.stderr
    assert "compiling kernels: double of chebsplat_kernels_of_a_test (kept in" in first.stderr
    assert second.stdout.startswith(f"6 0 {tmp_path / 'kept'}")
    assert second.stderr == ""
    assert third.stdout.startswith("6 1 "), third.stderr
    assert "is damaged" in third.stderr


@pytest.mark.parametrize("how", ["ro", "size=4k"])
def test_a_home_folder_that_takes_nothing_costs_no_run(tmp_path, how):
    if (unshare := namespace()) is None:
        pytest.skip("nothing can be mounted here (root, or user namespaces, are needed)")
    (tmp_path / "home").mkdir()
    mount = [
        *unshare,
        "sh",
        "-c",
        'mount -t tmpfs -o "$0" tmpfs "$1" && shift && exec "$@"',
        how,
        tmp_path / "home",
    ]
    done = run(tmp_path, mount, HOME=str(tmp_path / "home"), CHEBSPLAT_WORK=str(tmp_path / "work"))
    assert done.stdout.startswith("6 1 "), done.stderr
    assert f"{tmp_path}/home/.cache/chebsplat" in done.stderr
    assert "CHEBSPLAT_CACHE names another folder" in done.stderr
    assert "Traceback" not in done.stderr


CLONE = """
import numpy as np
from chebsplat.kernels import jit
from chebsplat.training.loss_kernels import _spread
_spread(0, 16, np.ones((4, 4, 8), np.float32), np.ones((16, 16, 8), np.float32))
print(jit.__file__, jit.compilation.kernels)
"""


def test_another_clone_of_the_same_source_finds_what_was_compiled(tmp_path):
    counts = []
    for name in ("first", "second"):
        shutil.copytree(
            Path(chebsplat.__file__).parent,
            tmp_path / name / "chebsplat",
            copy_function=shutil.copy,
        )
        env = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
        env |= {"CHEBSPLAT_CACHE": str(tmp_path / "kept"), "PYTHONPATH": str(tmp_path / name)}
        done = subprocess.run(
            [sys.executable, "-P", "-c", CLONE], capture_output=True, text=True, env=env
        )
        assert done.stdout.startswith(str(tmp_path / name)), done.stderr
        counts.append(int(done.stdout.split()[-1]))
    assert counts[0] > 0
    assert counts[1] == 0
