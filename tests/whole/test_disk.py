"""A disk that is full, read-only or not ours ends a command with exit code 4, the file, the bytes
and no traceback.
"""

import errno
import json
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import pytest
from shared import ROOT, TOY
from soak.disk import namespace

from chebsplat.errors import DiskFailure, InputError
from chebsplat.formats import artifact, files
from chebsplat.formats.capture import Capture
from chebsplat.formats.manifest import Manifest
from chebsplat.pipelines.running.run import failures
from chebsplat.stages.training.saves import Saves

MOUNT = 'mount -t tmpfs -o "$0" tmpfs "$1" && shift && exec "$@"'


@pytest.fixture(autouse=True)
def _no_work_folder_of_the_caller(monkeypatch):
    monkeypatch.delenv("CHEBSPLAT_WORK", raising=False)


def on_a_disk(folder, options, *arguments):
    """A `chebsplat` command whose work folder, or another, is a disk of its own."""
    if (unshare := namespace()) is None:
        pytest.skip("nothing can be mounted here (root, or user namespaces, are needed)")
    command = [
        *unshare,
        "sh",
        "-c",
        MOUNT,
        options,
        folder,
        sys.executable,
        "-P",
        "-m",
        "chebsplat.pipelines.cli",
    ]
    env = {"CHEBSPLAT_WORK": str(folder)} | os.environ
    return subprocess.run([*command, *arguments], cwd=ROOT, env=env, capture_output=True, text=True)


def test_a_stage_on_a_full_disk_exits_4_with_file_and_bytes(tmp_path):
    done = on_a_disk(tmp_path, "size=200k", "run", "--scene", "toy", "--stage", "ingest")
    assert done.returncode == 4
    assert "Traceback" not in done.stderr
    assert f"{tmp_path}/store/ingest" in done.stderr
    assert "No space left on device" in done.stderr
    assert re.search(r"more than [1-9][0-9,]* bytes are needed", done.stderr)


@pytest.mark.parametrize("options", ["ro", "size=4k"])
def test_a_work_folder_that_takes_nothing_is_said_before_anything_runs(tmp_path, options):
    done = on_a_disk(tmp_path, options, "run", "--scene", "toy")
    assert done.returncode == 4
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"chebsplat: {tmp_path}")
    assert "cannot be written" in done.stderr.splitlines()[-1]


def test_a_home_folder_that_takes_nothing_stops_no_run(tmp_path, monkeypatch):
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    done = on_a_disk(tmp_path / "home", "ro", "run", "--scene", "toy", "--stage", "ingest")
    assert done.returncode == 0, done.stderr


def in_a_shell(folder, words, buffered="", before=""):
    """A `chebsplat` command in a shell, whose streams `words` may redirect; its work folder is
    `folder`; `before`: what the shell does first.
    """
    env = os.environ | {
        "CHEBSPLAT_WORK": str(folder),
        "PYTHONUNBUFFERED": buffered,
        "PYTHONPATH": str(ROOT),
    }
    command = f"{sys.executable} -P -m chebsplat.pipelines.cli {words}"
    return subprocess.run(
        ["sh", "-c", before + command], cwd=folder, env=env, capture_output=True, text=True
    )


@pytest.mark.parametrize(
    ("words", "buffered"),
    [
        ("settings", "1"),
        ("settings --help", ""),
        ("--help", "1"),
        ("ingest --config toy.json --out made", ""),
    ],
)
def test_a_full_standard_output_is_named_and_no_folder_is_blamed(tmp_path, words, buffered):
    (tmp_path / "toy.json").write_text(json.dumps(TOY))
    done = in_a_shell(tmp_path, f"{words} > /dev/full", buffered)
    assert done.returncode == 4 and "Traceback" not in done.stderr
    assert done.stderr.count("standard output cannot be written (No space left on device)") == 1
    assert str(tmp_path) not in done.stderr
    if "made" in words:
        artifact.verify(tmp_path / "made", Capture.SCHEMA)


@pytest.mark.parametrize(("closed", "printed"), [("2>&-", "{}/made\n"), ("<&- >&- 2>&-", "")])
def test_closed_streams_keep_nothing_from_being_made_and_no_file_takes_their_place(
    tmp_path, closed, printed
):
    (tmp_path / "toy.json").write_text(json.dumps(TOY))
    done = in_a_shell(tmp_path, f"ingest --config toy.json --out made {closed}")
    assert (done.returncode, done.stdout) == (0, printed.format(tmp_path))
    artifact.verify(tmp_path / "made", Capture.SCHEMA)
    assert in_a_shell(tmp_path, f"settings nonsense {closed}").returncode == 2


def test_help_is_shown_in_a_folder_that_is_gone(tmp_path):
    done = in_a_shell(tmp_path, "--help", before="mkdir gone && cd gone && rmdir ../gone && ")
    assert done.returncode == 0 and "Usage" in done.stdout, done.stderr


def test_a_full_disk_is_recognised_behind_a_library_s_own_error(tmp_path):
    manifest, said = (
        Manifest("chebsplat.capture/2", "k", "ingest"),
        (
            r"a\.bin cannot be .*more than 3 bytes are "
            r"needed"
        ),
    )
    with pytest.raises(DiskFailure, match=said), artifact.publish(tmp_path / "x", manifest) as tmp:
        (tmp / "a.bin").write_bytes(b"abc")
        try:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp / "a.bin"))
        except OSError as error:
            raise RuntimeError("the codec failed") from error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("number", "state", "written", "said"),
    [
        (errno.ENOSPC, {}, 0, r"5 bytes are free in .*, and more are needed; make room and give"),
        (
            errno.ENOSPC,
            {},
            3,
            r"more than 3 bytes are needed in .*, 5 are free beside those; make "
            r"room and give",
        ),
        (
            errno.ENOSPC,
            {"f_favail": 0},
            3,
            r"holds as many files as it can; remove some, however "
            r"small, and give",
        ),
        (
            errno.EDQUOT,
            {},
            3,
            r"your quota is used up, though 5 bytes are free; remove files of "
            r"yours and give",
        ),
    ],
)
def test_a_full_disk_says_what_it_lacks(tmp_path, monkeypatch, number, state, written, said):
    disk = SimpleNamespace(
        **{"f_bavail": 5, "f_bfree": 5, "f_blocks": 9, "f_frsize": 1, "f_files": 9, "f_favail": 4}
        | state
    )
    monkeypatch.setattr(os, "statvfs", lambda path: disk)
    (tmp_path / "a.bin").write_bytes(bytes(written))
    with pytest.raises(DiskFailure, match=said), files.explained(tmp_path, scratch=True):
        raise OSError(number, os.strerror(number), str(tmp_path / "a.bin"))


def test_a_crash_that_is_not_the_disk_s_stays_one(tmp_path):
    with pytest.raises(ZeroDivisionError), files.explained(tmp_path):
        1 / 0  # noqa: B018
    assert not list(tmp_path.iterdir())


def test_a_file_that_may_not_be_read_is_an_input_s_fault(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    (tmp_path / "photo.jpg").touch()
    with pytest.raises(InputError, match=r"photo\.jpg cannot be read"), files.explained(tmp_path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(tmp_path / "photo.jpg"))


def test_a_training_goes_on_where_a_full_disk_takes_no_state(tmp_path, caplog, monkeypatch):
    def full(state, handle):
        handle.write(b"half")
        raise RuntimeError("unexpected pos")  # torch's word

    monkeypatch.setattr("torch.save", full)
    saves = Saves.__new__(Saves)
    saves.file, saves.identity, saves.saved = tmp_path / "training.pt", "i", 0.0
    saves.offer(dict, now=True)
    assert "the training goes on without" in caplog.text
    assert not list(tmp_path.iterdir())


def test_a_disk_that_filled_up_where_nobody_could_say_so_is_found_out(tmp_path, monkeypatch):
    def full(path, content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("chebsplat.pipelines.running.run.atomic_write", full)
    with pytest.raises(DiskFailure, match=f"{tmp_path}.*No space left"):
        failures([], tmp_path, tmp_path / "snakemake.log")
