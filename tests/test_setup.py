"""A clone that was renamed or copied sets itself up anew: nothing of another folder's .venv is run."""

import os
import shutil
import subprocess
from functools import partial

import pytest
from shared import ROOT

# What `python3.11` and .venv/bin/python do here: a venv that says where it was made, and nothing else; no downloads.
PYTHON = """#!/bin/bash
here=$(pwd -P)
case "$*" in
  "-m venv .venv")
    mkdir -p .venv/bin .venv/site/open3d
    cp "$0" .venv/bin/python
    printf '#!%s/.venv/bin/python\\n' "$here" > .venv/bin/chebsplat
    printf 'home = /usr/bin\\ncommand = /usr/bin/python3.11 -m venv %s/.venv\\n' "$here" > .venv/pyvenv.cfg ;;
  *purelib*) echo .venv/site ;;
  *sys.version_info*) exit 0 ;;
esac
"""


@pytest.fixture
def clone(tmp_path):
    """A checkout with the real Makefile and set-up, and a Python that installs nothing."""
    folder = tmp_path / "a clone"
    (folder / "pipelines").mkdir(parents=True)
    for name in ("Makefile", "pipelines/setup.sh", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, folder / name)
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin/python3.11"
    python.write_text(PYTHON)
    python.chmod(0o755)
    return folder


def make(folder, *targets):
    environment = os.environ | {"PATH": f"{folder.parent}/bin:{os.environ['PATH']}"}
    done = subprocess.run(["make", *targets], cwd=folder, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stderr


def made_in(folder):
    return (folder / ".venv/bin/chebsplat").read_text().strip().removeprefix("#!").removesuffix("/.venv/bin/python")


def test_setting_up_twice_does_nothing_the_second_time(clone):
    assert "setup: ready" in make(clone, "setup")
    assert make(clone, "setup") == ""


@pytest.mark.parametrize("change", [os.rename, partial(shutil.copytree, symlinks=True)], ids=["renamed", "copied"])
def test_a_renamed_or_copied_clone_makes_its_venv_anew(clone, change):
    make(clone, "setup")
    assert made_in(clone) == str(clone)
    other = clone.with_name("another clone")
    change(clone, other)
    told = make(other, "setup")
    assert f"was made for {clone}/.venv" in told
    assert made_in(other) == str(other)
    assert make(other, "setup") == ""


def test_a_venv_of_another_making_is_left_alone(clone):
    make(clone, "setup")
    (clone / ".venv/pyvenv.cfg").write_text("home = /usr/bin\nuv = 0.13\n")  # does not say where it was made
    assert make(clone, "setup") == ""
    shared = clone.with_name("shared")
    os.rename(clone / ".venv", shared)
    (shared / "pyvenv.cfg").write_text(f"command = /usr/bin/python3.11 -m venv {shared}\n")
    (clone / ".venv").symlink_to(shared)
    assert make(clone, "setup") == ""
