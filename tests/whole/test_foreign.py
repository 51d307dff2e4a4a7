"""What lies where the user stands is never run, and nothing is told to anyone or left behind in the
home folder.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from chebsplat.formats.teacher_model import EMBEDDED

CHEBSPLAT = str(Path(sys.executable).with_name("chebsplat"))
HOSTILE = (
    "humanfriendly",
    "click",
    "json",
    "yaml",
    "snakemake",
    "chebsplat",
    "formats",
    "numpy",
    "sitecustomize",
)


def chebsplat(folder, *arguments, **environment):
    """The command as a user calls it, from `folder`, with a home folder of its own."""
    (folder / "home").mkdir(exist_ok=True)
    env = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("CHEBSPLAT", "ORT_", "PYTHON"))
    }
    env |= {"HOME": str(folder / "home")} | environment
    env.pop("XDG_CACHE_HOME", None)
    return subprocess.run(
        [CHEBSPLAT, *map(str, arguments)], capture_output=True, text=True, cwd=folder, env=env
    )


@pytest.mark.xdist_group("cli")
def test_a_module_beside_the_photos_or_in_the_work_folder_is_never_run(tmp_path):
    (tmp_path / "work").mkdir()
    for folder in (tmp_path, tmp_path / "work"):
        for name in HOSTILE:
            mark = folder / f"ran-{name}"
            (folder / f"{name}.py").write_text(
                f"open({str(mark)!r}, 'w').close()\nraise SystemExit(9)\n"
            )
    done = chebsplat(tmp_path, "run", "--scene", "toy", "--stage", "ingest")
    assert not list(tmp_path.glob("**/ran-*"))
    assert done.returncode == 0, done.stderr


def test_onnxruntime_keeps_no_identity_of_the_machine_in_the_home_folder(tmp_path):
    done = chebsplat(tmp_path, "check-teacher", EMBEDDED, TMPDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")}
    assert not [
        path for path in left if any(word in path for word in ("onnx", "Microsoft", "deviceid"))
    ]
    assert ".ses" not in left  # a session's id


@pytest.mark.parametrize("said", ["0", "1"])
def test_what_the_user_says_of_telemetry_stands(said):
    program = "import os, chebsplat; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    env = os.environ | {"ORT_DISABLE_TELEMETRY": said}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=env)
    assert done.stdout == f"{said}\n"


def test_git_is_not_asked_about_a_repository_that_chebsplat_is_merely_installed_in(tmp_path):
    from chebsplat.pipelines.running.run import git_state

    layer = tmp_path / "project/.venv/site-packages/chebsplat/pipelines"
    layer.mkdir(parents=True)
    git = ["git", "-C", tmp_path / "project", "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "theirs"]):
        subprocess.run([*git, *words], check=True)
    hook = tmp_path / "hook"
    hook.write_text(f"#!/bin/sh\ntouch {tmp_path / 'ran'}\n")
    hook.chmod(0o755)
    subprocess.run([*git, "config", "core.fsmonitor", hook], check=True)
    assert git_state(layer) == {}
    assert not (tmp_path / "ran").exists()
    shutil.copytree(layer, tmp_path / "project/pipelines")
    assert git_state(tmp_path / "project/pipelines").keys() == {"commit", "dirty"}
    assert (tmp_path / "ran").exists()  # as git does in a checkout that is ours
