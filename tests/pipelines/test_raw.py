"""An artifact is published under the key of what was read, or not at all, whatever becomes of the
sources meanwhile.
"""

import json
import os
import shutil

import numpy as np
import onnx
import pytest
from source_folders import image, write_colmap
from tiny_teachers import COLORS, color_reference, color_teacher, moved_out, write_table

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.pipelines.planning import raw
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.planning.raw import hashes, raw_files, unchanged
from chebsplat.pipelines.running import job
from chebsplat.pipelines.running.run import entry, write_plan
from chebsplat.pipelines.work import store
from chebsplat.stages.registry import STAGES

pytestmark = pytest.mark.usefixtures("own_work")


@pytest.fixture
def photos(tmp_path):
    write_colmap(tmp_path / "room", names=[f"{k}.png" for k in range(4)])
    for k in range(4):
        image(tmp_path / f"room/images/{k}.png", value=60 * k)
    return tmp_path / "room/images"


def planned(stage, *arguments):
    """A step of a plan, and the plan as its job finds it."""
    planner = Planner()
    step = next(step for step in planner.plan(*map(str, arguments)).steps if step.stage == stage)
    planner.save()
    return step, write_plan(store.work() / f".plans/{stage}", [entry(step, {})], {})


def same_size_and_time(path, data):
    """Write other bytes as a careful forger does: size and time of modification stay."""
    state = path.stat()
    path.write_bytes(data.ljust(state.st_size, b"\0")[: state.st_size])
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def edited(photos):
    same_size_and_time(photos / "2.png", (photos / "1.png").read_bytes())
    return "2.png"


def added(photos):
    shutil.copy(photos / "1.png", photos / "7.png")
    return "7.png"


def removed(photos):
    (photos / "2.png").unlink()
    return "2.png"


def replaced(photos):
    shutil.copystat(photos / "2.png", photos / "1.png")
    os.replace(photos / "1.png", photos / "2.png")
    return ".png"


CHANGES = [edited, added, removed, replaced]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("when", ["before", "while"])
def test_photos_that_change_after_they_were_planned_are_named(photos, change, when):
    step, _ = planned("ingest", photos.parent)
    named = change(photos) if when == "before" else ""
    with (
        pytest.raises(InputError, match="run again") as error,
        unchanged("ingest", step.sections, step.raw),
    ):
        assert when == "while"
        named = change(photos)
    assert named in str(error.value)


def test_of_photos_that_change_nothing_is_published_under_the_key_of_the_old(photos, capfd):
    step, plan = planned("ingest", photos.parent)
    named = edited(photos)
    assert job.run(plan, step.key) == 3
    assert named in capfd.readouterr().err
    assert not step.path.exists()
    again, plan = planned("ingest", photos.parent)
    assert again.key != step.key
    assert job.run(plan, again.key) == 0
    assert artifact.verify(again.path).key == again.key


@pytest.mark.parametrize(
    ("stage", "file"),
    [
        ("channels", "model"), ("channels", "reference"), ("teacher", "model"),
        ("teacher", "labels"),
        ("evaluate", "weights"),
    ],
)  # fmt: skip
def test_models_labels_and_weights_are_watched_too(tmp_path, stage, file):
    reference, labels, weights = (tmp_path / name for name in ("reference", "labels.txt", "lpips"))
    model = color_teacher(tmp_path)
    color_reference(reference)
    labels.write_text("red\ngreen\nblue\n")
    weights.write_bytes(b"weights")
    settings = f"teacher.kind=onnx,teacher.model={model},teacher.labels={labels}"
    settings += f",channels.reference={reference},evaluate.lpips_weights={weights}"
    step, _ = planned(stage, "toy", settings)
    images = sorted(reference.iterdir())
    watched = {"model": model, "reference": images[0], "labels": labels, "weights": weights}[file]
    with (
        pytest.raises(InputError, match=f"{watched} has changed"),
        unchanged(stage, step.sections, step.raw),
    ):
        same_size_and_time(watched, watched.read_bytes()[:-1] + b"?")


def behind(*names):
    """These stages, and all that read anything of them."""
    found = set(names)
    while (
        more := {name for name, stage in STAGES.items() if found & {*stage.roles.values()}} - found
    ):
        found |= more
    return found


@pytest.mark.parametrize("weights", ["", "tiny.onnx.data", "tiny.onnx_data", "weights.bin"])
def test_any_byte_that_a_teacher_reads_makes_it_and_what_follows_anew_and_nothing_else_does(
    tmp_path, weights
):
    """Its text encoder's, too; the files are those of the graph, not of a usual name."""
    model = color_teacher(tmp_path, text="text.onnx", tokenizer="tokenizer.json")
    (tmp_path / "tokenizer.json").write_text("{}")
    shutil.copy(model, tmp_path / "text.onnx")
    read = {
        name: tmp_path / name for name in ("tiny.onnx", "tiny.toml", "tokenizer.json", "text.onnx")
    }
    if weights:
        moved_out(model, weights)
        moved_out(tmp_path / "text.onnx", "words.bin")
        read |= {name: tmp_path / name for name in (weights, "words.bin")}

    def keys():
        plan = Planner().plan("toy", f"teacher.kind=onnx,teacher.model={model}")
        return {step.stage: step.key for step in plan.steps}

    before, follows = keys(), behind("channels", "teacher")
    for name, path in read.items():
        data = path.read_bytes()
        path.write_bytes(
            data + b"\n" if name.endswith(("toml", "json")) else data[:-1] + bytes([data[-1] ^ 1])
        )
        if name == "tiny.onnx" and weights:  # a graph that parses
            path.write_bytes(data + onnx.ModelProto(doc_string="other").SerializeToString())
        assert {stage for stage, key in keys().items() if key != before[stage]} == follows & {
            *before
        }, name
        path.write_bytes(data)
    write_table(tmp_path / "tiny.npz", embeddings=2 * np.array([*COLORS.values()]))
    assert {stage for stage, key in keys().items() if key != before[stage]} == follows & {*before}
    write_table(tmp_path / "tiny.npz")
    for stray in {"tiny.onnx.data", "tiny.onnx_data", "weights.bin", "tiny.relevancy.json"} - {
        weights
    }:
        (tmp_path / stray).write_bytes(b"of something else")
    assert keys() == before
    if weights:
        (tmp_path / weights).unlink()
        with pytest.raises(
            InputError,
            match=rf"{weights} is missing; .*tiny.onnx keeps weights "
            r"there",
        ):
            keys()


def test_files_that_were_not_touched_for_long_are_not_read_again(photos, monkeypatch):
    _, files = raw_files("ingest", {"source": {"kind": "colmap", "path": str(photos.parent)}})
    monkeypatch.setattr(raw, "SETTLED", -1)
    memo = {}
    found = hashes(files, memo)
    assert set(memo) == set(found) == set(map(str, files))
    monkeypatch.setattr(raw, "sha256_file", None)
    assert hashes(files, json.loads(json.dumps(memo))) == found


def test_a_file_that_has_changed_just_now_is_read_again(photos):
    memo = {}
    found = hashes([photos / "1.png"], memo)
    assert memo == {}
    assert not found[str(photos / "1.png")][2]


@pytest.mark.parametrize(
    "damage", ["[]", "{", '{"PATH": 5}', '{"PATH": [1]}', '{"PATH": [[1, 2], 7]}', "[" * 10**5]
)
def test_a_damaged_memory_of_hashes_costs_time_only(photos, own_work, damage):
    step, _ = planned("ingest", photos.parent)
    code = next(path for path in Planner().code.memo)
    for name, path in (("files", photos / "1.png"), ("code", code)):
        (own_work / ".cache").mkdir(exist_ok=True)
        (own_work / f".cache/{name}.json").write_text(damage.replace("PATH", str(path)))
    again, _ = planned("ingest", photos.parent)
    assert again.key == step.key


def test_names_that_are_not_utf8_are_hashed(tmp_path):
    path = tmp_path / os.fsdecode(b"\xff.png")
    path.write_bytes(b"x")
    assert raw.content_hash(hashes([path], {}), tmp_path)


def test_a_finished_step_is_made_again_where_a_member_is_gone(photos):
    step, plan = planned("ingest", photos.parent)
    assert job.run(plan, step.key) == 0 and step.fresh
    member = next(path for path in step.path.rglob("*") if path.name == "zarr.json")
    member.unlink()
    assert not store.is_fresh(step.path)
    assert job.run(plan, step.key) == 0
    assert artifact.verify(step.path).key == step.key
