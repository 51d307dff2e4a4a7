"""Artifacts are published whole or not at all, and damage is named."""

import json
import os

import numpy as np
import pytest
from shared import KEY, key_of

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.manifest import MANIFEST, Manifest
from chebsplat.formats.tensors import write_tensors

SCHEMA = "chebsplat.capture/2"


def make(path, text="hello"):
    with artifact.publish(path, Manifest("chebsplat.capture/2", KEY, "ingest")) as tmp:
        (tmp / "data").mkdir()
        (tmp / "data" / "a.txt").write_text(text)
    return path


def test_published_artifact_verifies(tmp_path):
    manifest = artifact.verify(make(tmp_path / "x"), "chebsplat.capture/2")
    assert list(manifest.files) == ["data/a.txt"]
    assert os.listdir(tmp_path) == ["x"]


def test_failed_block_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), artifact.publish(tmp_path / "x", Manifest("s/1", KEY, "s")) as tmp:
        (tmp / "half").write_text("half")
        raise RuntimeError
    assert os.listdir(tmp_path) == []


def test_twin_that_won_is_kept(tmp_path):
    with artifact.publish(tmp_path / "x", Manifest("chebsplat.capture/2", KEY, "ingest")) as tmp:
        (tmp / "late.txt").write_text("late")
        make(tmp_path / "x", "first")
    assert (tmp_path / "x/data/a.txt").read_text() == "first"
    assert not (tmp_path / "x/late.txt").exists()


def test_foreign_directory_is_never_overwritten(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x/thesis.tex").write_text("years")
    with pytest.raises(InputError, match="not an artifact"):
        make(tmp_path / "x")
    with pytest.raises(ValueError, match="no scratch"):
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
        named = path / MANIFEST
        named.write_text("{") if damage == "manifest" else named.unlink()
    with pytest.raises(InputError) as error:
        artifact.verify(path)
    assert str(named) in str(error.value)
    assert "again" in str(error.value)


def test_wrong_schema_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="expected"):
        artifact.read_manifest(make(tmp_path / "x"), "chebsplat.points/2")


def test_an_artifact_of_another_version_of_its_schema_says_that_it_is_to_be_made_again(tmp_path):
    path = make(tmp_path / "x")
    name, _, version = artifact.read_manifest(path).schema.rpartition("/")
    with pytest.raises(InputError, match="another version of chebsplat made it: make it again"):
        artifact.read_manifest(path, f"{name}/{int(version) + 1}")


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_files_are_as_readable_as_the_umask_says_whoever_wrote_them(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        with artifact.publish(tmp_path / "x", Manifest("chebsplat.capture/2", KEY, "ingest")) as tmp:
            write_tensors(tmp / "a.safetensors", {"a": np.zeros(3, np.float32)})  # gives its file to the owner alone
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


def test_a_damaged_artifact_is_replaced_in_the_folder_that_bears_its_key_and_a_twin_s_is_kept(tmp_path):
    path = tear(make(tmp_path / KEY))
    assert not artifact.is_whole(path)
    assert (make(path, "again") / "data/a.txt").read_text() == "again"
    assert (make(path, "third") / "data/a.txt").read_text() == "again"
    with artifact.publish(path, Manifest(SCHEMA, KEY, "ingest")) as tmp:
        tear(path)
        (tmp / "b.txt").write_text("ours")
        assert (path / "data/a.txt").is_file()  # what stands there stays until the block has ended
        (path / MANIFEST).write_text("{")
    assert sorted(artifact.verify(path).files) == ["b.txt"]
    assert os.listdir(tmp_path) == [KEY]


def test_readers_see_a_whole_artifact_or_none_while_a_damaged_one_is_replaced(tmp_path, monkeypatch):
    path, seen = tear(make(tmp_path / KEY)), []
    rename = os.rename

    def watched(source, target):
        try:
            rename(source, target)
        finally:
            seen.append("whole" if artifact.is_whole(path) else "damaged" if path.exists() else "none")

    monkeypatch.setattr(os, "rename", watched)
    make(path)
    assert seen == ["damaged", "none", "whole"]  # the first finds that something stands there


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("place", ["link", "folder", "other stage", "with a note", "file", "dangling"])
def test_what_is_not_this_stage_s_artifact_is_never_replaced(tmp_path, place, force):
    out, other = tmp_path / "x", tmp_path / "other"
    if place == "link":
        out.symlink_to(make(other))
    elif place == "dangling":
        out.symlink_to(tmp_path / "nothing")
    elif place == "folder":
        out.mkdir()
        (out / "artifact.json").write_text('{"title": "a list of my artifacts"}')
    elif place == "file":
        out.write_text("years")
    else:
        with artifact.publish(out, Manifest("chebsplat.points/2" if place == "other stage" else SCHEMA, KEY, "s")):
            pass
        (out / "thesis.tex").write_text("years")
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(InputError, match="nothing was replaced") as error:
        artifact.check_place(out, SCHEMA, key_of("another"), force)
    assert str(out) in str(error.value)
    assert "delete" not in str(error.value)
    if place not in ("link", "with a note") or force:
        with pytest.raises(InputError), artifact.publish(out, Manifest(SCHEMA, key_of("another"), "s"), force):
            pass
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_force_replaces_an_artifact_of_this_stage_when_the_new_one_is_there(tmp_path):
    out = make(tmp_path / "x", "old")
    with pytest.raises(RuntimeError), artifact.publish(out, Manifest(SCHEMA, key_of("new"), "s"), force=True):
        raise RuntimeError
    assert artifact.verify(out).key == KEY
    with artifact.publish(out, Manifest(SCHEMA, key_of("new"), "s"), force=True):
        pass
    assert artifact.verify(out).key == key_of("new")
    assert os.listdir(tmp_path) == ["x"]


BAD_MANIFESTS = {
    "no object": lambda m: [m],
    "another field": lambda m: m | {"extra": 1},
    "no key": lambda m: {k: v for k, v in m.items() if k != "key"},
    "an absolute key": lambda m: m | {"key": "/etc"},
    "a key that climbs": lambda m: m | {"key": "../../../x"},
    "an empty key": lambda m: m | {"key": ""},
    "a key of capitals": lambda m: m | {"key": "A" * 16},
    "an input's key": lambda m: m | {"inputs": {"capture": {"key": "../x", "schema": "s/1"}}},
    "inputs that are a list": lambda m: m | {"inputs": [KEY]},
    "files that are a list": lambda m: m | {"files": ["data/a.txt"]},
    "an absolute file": lambda m: m | {"files": {"/etc/hostname": m["files"]["data/a.txt"]}},
    "a file that climbs": lambda m: m | {"files": {"../x/data/a.txt": m["files"]["data/a.txt"]}},
    "a file spelt twice": lambda m: m | {"files": {"data//a.txt": m["files"]["data/a.txt"]}},
    "no sha256": lambda m: m | {"files": {"data/a.txt": {"bytes": 5}}},
    "no bytes": lambda m: m | {"files": {"data/a.txt": {"sha256": "0" * 64}}},
}


@pytest.mark.parametrize("change", BAD_MANIFESTS.values(), ids=BAD_MANIFESTS)
def test_a_manifest_that_breaks_a_rule_is_damaged_for_every_reader(tmp_path, change):
    path = make(tmp_path / "x")
    file = path / MANIFEST
    file.write_text(json.dumps(change(json.loads(file.read_text()))))
    for read in (artifact.read_manifest, artifact.verify):
        with pytest.raises(InputError, match=f"{file} is damaged"):
            read(path)
    assert not artifact.is_whole(path)


def test_a_manifest_that_is_nested_too_deeply_is_damaged(tmp_path):
    path = make(tmp_path / "x")
    (path / MANIFEST).write_text("[" * 100_000)
    with pytest.raises(InputError, match="too deeply"):
        artifact.verify(path)


def test_a_copy_is_verified(tmp_path):
    path = make(tmp_path / "x")
    manifest = artifact.verify(path)
    artifact.copy(path, tmp_path / "y", manifest)
    assert artifact.verify(tmp_path / "y") == artifact.verify(path) == manifest
    (path / "data/a.txt").write_text("HELLO")
    with pytest.raises(InputError, match="changed while it was copied"):
        artifact.copy(path, tmp_path / "z", manifest)
    assert not (tmp_path / "z").exists()
