"""Artifacts are published whole or not at all, and damage is named."""

import os

import numpy as np
import pytest
from malformed.commands import PLACES, with_a_note
from malformed.edits import changed, cut, flipped, put, remove
from shared import KEY, key_of

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.manifest import MANIFEST, Manifest
from chebsplat.formats.tensors import write_tensors

SCHEMA = "chebsplat.capture/2"
MEMBER = "data/a.txt"


def publishing(path, name=None, force=False):
    return artifact.publish(path, Manifest(SCHEMA, key_of(name) if name else KEY, "ingest"), force)


def make(path, text="hello"):
    with publishing(path) as tmp:
        put(MEMBER, text)(tmp)
    return path


def test_published_artifact_verifies(tmp_path):
    manifest = artifact.verify(make(tmp_path / "x"), SCHEMA)
    assert list(manifest.files) == ["data/a.txt"]
    assert os.listdir(tmp_path) == ["x"]


def test_failed_block_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), publishing(tmp_path / "x") as tmp:
        (tmp / "half").write_text("half")
        raise RuntimeError
    assert os.listdir(tmp_path) == []


def test_twin_that_won_is_kept(tmp_path):
    with publishing(tmp_path / "x") as tmp:
        (tmp / "late.txt").write_text("late")
        make(tmp_path / "x", "first")
    assert (tmp_path / "x/data/a.txt").read_text() == "first"
    assert not (tmp_path / "x/late.txt").exists()


DAMAGES = {
    "truncate": (MEMBER, cut(MEMBER, 1)),
    "flip": (MEMBER, flipped(MEMBER)),
    "delete": (MEMBER, remove(MEMBER)),
    "extra": ("extra.bin", put("extra.bin", "?")),
    "manifest": (MANIFEST, put(MANIFEST, "{")),
    "no manifest": (MANIFEST, remove(MANIFEST)),
}


@pytest.mark.parametrize(("named", "damage"), DAMAGES.values(), ids=DAMAGES)
def test_damage_is_named_with_the_remedy(tmp_path, named, damage):
    path = make(tmp_path / "x")
    damage(path)
    with pytest.raises(InputError, match=f"{path / named} .*again"):
        artifact.verify(path)


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_files_are_as_readable_as_the_umask_says_whoever_wrote_them(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        with publishing(tmp_path / "x") as tmp:
            # gives its file to the owner alone
            write_tensors(tmp / "a.safetensors", {"a": np.zeros(3, np.float32)})
            (tmp / "b.txt").write_text("b")
    finally:
        os.umask(before)
    files = [path for path in (tmp_path / "x").rglob("*") if path.is_file()]
    assert len(files) == 3
    assert {path.stat().st_mode & 0o777 for path in files} == {mode}


def tear(path):
    """Damage an artifact as a crash or a careless hand does."""
    (path / "data/a.txt").write_text("hel")
    return path


def test_a_damaged_artifact_is_replaced_in_the_folder_that_bears_its_key_and_a_twin_s_is_kept(
    tmp_path,
):
    path = tear(make(tmp_path / KEY))
    assert not artifact.is_whole(path)
    assert (make(path, "again") / "data/a.txt").read_text() == "again"
    assert (make(path, "third") / "data/a.txt").read_text() == "again"
    with publishing(path) as tmp:
        tear(path)
        (tmp / "b.txt").write_text("ours")
        assert (path / "data/a.txt").is_file()  # what stands there stays until the block has ended
        (path / MANIFEST).write_text("{")
    assert sorted(artifact.verify(path).files) == ["b.txt"]
    assert os.listdir(tmp_path) == [KEY]


def test_readers_see_a_whole_artifact_or_none_while_a_damaged_one_is_replaced(
    tmp_path, monkeypatch
):
    path, seen = tear(make(tmp_path / KEY)), []
    rename = os.rename

    def watched(source, target):
        try:
            rename(source, target)
        finally:
            seen.append(
                "whole" if artifact.is_whole(path) else "damaged" if path.exists() else "none"
            )

    monkeypatch.setattr(os, "rename", watched)
    make(path)
    assert seen == ["damaged", "none", "whole"]  # the first finds that something stands there


OTHERS = {what: stands for what, (stands, place, _) in PLACES.items() if place == "mine"} | {
    "a note": with_a_note
}


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("stands", OTHERS.values(), ids=OTHERS)
def test_publishing_never_replaces_what_is_not_this_stage_s_artifact(tmp_path, stands, force):
    out = tmp_path / "mine"
    stands(out)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    # a whole one is kept without a word, as a twin's is
    if force or not artifact.is_whole(out, SCHEMA):
        with (
            pytest.raises(InputError, match=f"{out}.*nothing was replaced") as error,
            publishing(out, "new", force),
        ):
            pass
        assert "delete" not in str(error.value)
    with pytest.raises(ValueError, match="no scratch"):
        artifact.discard(out)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_force_replaces_an_artifact_of_this_stage_when_the_new_one_is_there(tmp_path):
    out = make(tmp_path / "x", "old")
    with pytest.raises(RuntimeError), publishing(out, "new", force=True):
        raise RuntimeError
    assert artifact.verify(out).key == KEY
    with publishing(out, "new", force=True):
        pass
    assert artifact.verify(out).key == key_of("new")
    assert os.listdir(tmp_path) == ["x"]


BAD_MANIFESTS = {
    "another field": lambda m: m | {"extra": 1},
    "a key of capitals": lambda m: m | {"key": "A" * 16},
    "inputs that are a list": lambda m: m | {"inputs": [KEY]},
    "files that are a list": lambda m: m | {"files": ["data/a.txt"]},
    "a file spelt twice": lambda m: m | {"files": {"data//a.txt": m["files"]["data/a.txt"]}},
    "no sha256": lambda m: m | {"files": {"data/a.txt": {"bytes": 5}}},
    "no bytes": lambda m: m | {"files": {"data/a.txt": {"sha256": "0" * 64}}},
}


@pytest.mark.parametrize("change", BAD_MANIFESTS.values(), ids=BAD_MANIFESTS)
def test_a_manifest_that_breaks_a_rule_is_damaged_for_every_reader(tmp_path, change):
    path = make(tmp_path / "x")
    changed(MANIFEST, change)(path)
    for read in (artifact.read_manifest, artifact.verify):
        with pytest.raises(InputError, match=f"{path / MANIFEST} is damaged"):
            read(path)
    assert not artifact.is_whole(path)


def test_a_copy_is_verified(tmp_path):
    path = make(tmp_path / "x")
    manifest = artifact.verify(path)
    artifact.copy(path, tmp_path / "y", manifest)
    assert artifact.verify(tmp_path / "y") == artifact.verify(path) == manifest
    (path / "data/a.txt").write_text("HELLO")
    with pytest.raises(InputError, match="changed while it was copied"):
        artifact.copy(path, tmp_path / "z", manifest)
    assert not (tmp_path / "z").exists()
