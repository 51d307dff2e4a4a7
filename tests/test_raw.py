"""An artifact is published under the key of what was read, or not at all, whatever becomes of the sources meanwhile."""

import json
import os
import shutil
import threading
import time
from types import SimpleNamespace

import pytest
from tiny_teachers import color_reference, color_teacher

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.pipelines import job, raw, store
from chebsplat.pipelines.plan import Planner
from chebsplat.pipelines.raw import hashes, raw_files, unchanged
from chebsplat.pipelines.run import entry, write_plan

pytestmark = pytest.mark.usefixtures("own_work")


@pytest.fixture
def photos(tmp_path):
    from PIL import Image

    (tmp_path / "photos").mkdir()
    for k in range(4):
        Image.new("RGB", (32, 24), (60 * k, 0, 0)).save(tmp_path / f"photos/{k}.png")
    return tmp_path / "photos"


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
def test_photos_changed_between_plan_and_read_are_not_published(photos, change, capfd):
    step, plan = planned("ingest", photos)
    named = change(photos)
    assert job.run(plan, step.key) == 3
    told = capfd.readouterr().err
    assert named in told and "run again" in told
    assert not step.path.exists()
    again, plan = planned("ingest", photos)
    assert again.key != step.key
    assert job.run(plan, again.key) == 0
    assert artifact.verify(again.path).key == again.key


def back_and_forth(photos):
    """Another photo while it is read, the old one afterwards: nothing but the time of change tells."""
    held = (photos / "2.png").read_bytes()
    edited(photos)
    time.sleep(0.05)
    same_size_and_time(photos / "2.png", held)
    return "2.png"


@pytest.mark.parametrize("change", [*CHANGES, back_and_forth])
def test_photos_changed_in_the_middle_of_reading_are_not_published(photos, change, capfd, monkeypatch):
    from chebsplat.stages.sources import pictures

    step, plan = planned("ingest", photos)
    open_photo, named, once = pictures.open_photo, [], threading.Lock()

    def opened(path, *arguments):
        found = open_photo(path, *arguments)
        if once.acquire(blocking=False):  # photos are read by several threads
            named.append(change(photos))
        return found

    monkeypatch.setattr("chebsplat.stages.sources.assembly.open_photo", opened)
    assert job.run(plan, step.key) == 3
    assert named and named[0] in capfd.readouterr().err
    assert not step.path.exists()
    assert not [path for path in step.path.parent.iterdir() if path.name.startswith(".tmp")]


@pytest.mark.parametrize("when", ["before", "while"])
@pytest.mark.parametrize("stage", ["channels", "teacher"])
def test_a_teacher_that_is_exported_anew_meanwhile_is_noticed(tmp_path, stage, when, capfd, monkeypatch):
    model = color_teacher(tmp_path)
    color_reference(tmp_path / "reference")
    (tmp_path / "colours.txt").write_text("red\ngreen\nblue\n")
    settings = f"teacher.kind=onnx,teacher.model={model},channels.reference={tmp_path / 'reference'}"
    settings += f",teacher.labels={tmp_path / 'colours.txt'}"
    step, plan = planned(stage, "toy", settings)
    for of in ("ingest", "channels") if stage == "teacher" else ():
        earlier, its_plan = planned(of, "toy", settings)
        assert job.run(its_plan, earlier.key) == 0
    swap = SimpleNamespace(done=False)

    def exported_anew():
        swap.done = True
        same_size_and_time(model, model.read_bytes()[:-1] + b"?")

    if when == "before":
        exported_anew()
    else:
        from chebsplat.stages.teacher_inference import TeacherInference

        encode = TeacherInference.features

        def encoded(self, *arguments):
            if not swap.done:
                exported_anew()
            return encode(self, *arguments)

        monkeypatch.setattr(TeacherInference, "features", encoded)
    assert job.run(plan, step.key) == 3
    assert swap.done
    assert f"{model} has changed" in capfd.readouterr().err
    assert not step.path.exists()


def test_weights_of_lpips_are_watched_too(tmp_path):
    weights = tmp_path / "lpips.safetensors"
    weights.write_bytes(b"weights")
    step, _ = planned("evaluate", "toy", f"evaluate.lpips_weights={weights}")
    assert list(step.raw) == [str(weights)]
    with pytest.raises(InputError, match="has changed"), unchanged("evaluate", step.sections, step.raw):
        same_size_and_time(weights, b"WEIGHTS")


def test_files_that_were_not_touched_for_long_are_not_read_again(photos, monkeypatch):
    _, files = raw_files("ingest", {"source": {"kind": "photos", "path": str(photos)}})
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


@pytest.mark.parametrize("damage", ["[]", "{", '{"PATH": 5}', '{"PATH": [1]}', '{"PATH": [[1, 2], 7]}', "[" * 10**5])
def test_a_damaged_memory_of_hashes_costs_time_only(photos, own_work, damage):
    step, _ = planned("ingest", photos)
    code = next(path for path in Planner().code.memo)
    for name, path in (("files", photos / "1.png"), ("code", code)):
        (own_work / ".cache").mkdir(exist_ok=True)
        (own_work / f".cache/{name}.json").write_text(damage.replace("PATH", str(path)))
    again, _ = planned("ingest", photos)
    assert again.key == step.key


def test_names_that_are_not_utf8_are_hashed(tmp_path):
    path = tmp_path / os.fsdecode(b"\xff.png")
    path.write_bytes(b"x")
    assert raw.content_hash(hashes([path], {}), tmp_path)


def test_a_finished_step_is_made_again_where_a_member_is_gone(photos):
    step, plan = planned("ingest", photos)
    assert job.run(plan, step.key) == 0 and step.fresh
    member = next(path for path in step.path.rglob("*") if path.name == "cameras.safetensors")
    member.unlink()
    assert not store.is_fresh(step.path)
    assert job.run(plan, step.key) == 0
    assert artifact.verify(step.path).key == step.key
