"""Artifacts are published whole or not at all, and damage is named."""

import os

import numpy as np
import pytest

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.artifact import Manifest
from chebsplat.formats.tensors import write_tensors


def make(path, text="hello"):
    with artifact.publish(path, Manifest("chebsplat.capture/1", "k", "ingest")) as tmp:
        (tmp / "data").mkdir()
        (tmp / "data" / "a.txt").write_text(text)
    return path


def test_published_artifact_verifies(tmp_path):
    manifest = artifact.verify(make(tmp_path / "x"), "chebsplat.capture/1")
    assert list(manifest.files) == ["data/a.txt"]
    assert os.listdir(tmp_path) == ["x"]


def test_failed_block_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), artifact.publish(tmp_path / "x", Manifest("s/1", "k", "s")) as tmp:
        (tmp / "half").write_text("half")
        raise RuntimeError
    assert os.listdir(tmp_path) == []


def test_twin_that_won_is_kept(tmp_path):
    with artifact.publish(tmp_path / "x", Manifest("chebsplat.capture/1", "k", "ingest")) as tmp:
        (tmp / "late.txt").write_text("late")
        make(tmp_path / "x", "first")
    assert (tmp_path / "x/data/a.txt").read_text() == "first"
    assert not (tmp_path / "x/late.txt").exists()


def test_foreign_directory_is_never_overwritten(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x/thesis.tex").write_text("years")
    with pytest.raises(InputError, match="not an artifact"):
        make(tmp_path / "x")
    with pytest.raises(InputError, match="nothing was removed"):
        artifact.discard(tmp_path / "x")
    assert (tmp_path / "x/thesis.tex").read_text() == "years"


@pytest.mark.parametrize("damage", ["truncate", "flip", "delete", "extra", "manifest", "no manifest"])
def test_damage_is_named_with_the_remedy(tmp_path, damage):
    path = make(tmp_path / "x")
    victim = path / "data/a.txt"
    named = victim
    if damage == "truncate":
        victim.write_text("hell")
    elif damage == "flip":
        victim.write_text("hellp")
    elif damage == "delete":
        victim.unlink()
    elif damage == "extra":
        named = path / "extra.bin"
        named.write_bytes(b"?")
    else:
        named = path / artifact.MANIFEST
        named.write_text("{") if damage == "manifest" else named.unlink()
    with pytest.raises(InputError) as error:
        artifact.verify(path)
    assert str(named) in str(error.value)
    assert "again" in str(error.value)


def test_wrong_schema_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="expected"):
        artifact.read_manifest(make(tmp_path / "x"), "chebsplat.points/1")


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_files_are_as_readable_as_the_umask_says_whoever_wrote_them(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        with artifact.publish(tmp_path / "x", Manifest("chebsplat.capture/1", "k", "ingest")) as tmp:
            write_tensors(tmp / "a.safetensors", {"a": np.zeros(3, np.float32)})  # gives its file to the owner alone
            (tmp / "b.txt").write_text("b")
    finally:
        os.umask(before)
    files = [path for path in (tmp_path / "x").rglob("*") if path.is_file()]
    assert len(files) == 3
    assert {path.stat().st_mode & 0o777 for path in files} == {mode}
