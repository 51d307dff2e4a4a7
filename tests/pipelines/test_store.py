"""The work folder: names that lead nowhere else, links that lead in circles, members that are
gone.
"""

import json
import os

import pytest
from shared import ROOT, finish, key_of, remember

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import artifact
from chebsplat.formats.manifest import Manifest
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.work import heads, store


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch, code_memo):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.chdir(ROOT)
    return remember(tmp_path / "work", code_memo)


def damaged(path, how):
    member = path / "data.bin"
    with artifact.publish(
        path, Manifest("chebsplat.points/2", path.name, "sfm"), force=True
    ) as tmp:
        (tmp / "data.bin").write_bytes(bytes(100))
    if how == "a member is gone":
        member.unlink()
    elif how == "a member is cut off":
        member.write_bytes(bytes(99))
    elif how == "the manifest is cut off":
        (path / "artifact.json").write_text("{")
    else:
        (path / "artifact.json").unlink()


@pytest.mark.parametrize(
    "how",
    ["a member is gone", "a member is cut off", "the manifest is cut off", "the manifest is gone"],
)
def test_a_damaged_artifact_is_stale_alone(how):
    plan = Planner().plan("toy")
    finish(plan)
    damaged(plan.targets["sfm"], how)
    assert [step.stage for step in plan.steps if not step.fresh] == ["sfm"]
    store.link("toy", plan.targets)
    assert not (store.work() / "toy/sfm").exists()


def test_a_damaged_artifact_keeps_what_it_was_made_of_from_clean_stale():
    plan = Planner().plan("toy")
    finish(plan)
    store.link("toy", {"report": plan.targets["report"]})
    inputs = {"capture": {"key": plan.targets["ingest"].name, "schema": "s/1"}}
    path = plan.targets["sfm"]
    with artifact.publish(
        path, Manifest("chebsplat.points/2", path.name, "sfm", inputs), force=True
    ) as tmp:
        (tmp / "data.bin").write_bytes(bytes(100))
    (path / "data.bin").unlink()
    assert {path, plan.targets["ingest"]}.isdisjoint(
        found for found, _ in store.list_unreferenced()
    )


def test_links_that_lead_in_a_circle_or_out_of_the_store_are_removed_alone(work, tmp_path):
    with artifact.publish(tmp_path / "mine", Manifest("chebsplat.points/2", key_of("mine"), "sfm")):
        pass
    (work / "toy").mkdir()
    (work / "toy/sfm").symlink_to("sfm")
    (work / "store/sfm").mkdir(parents=True)
    circle, elsewhere = work / "store/sfm" / key_of(1), work / "store/sfm" / key_of(2)
    circle.symlink_to(circle.name)
    elsewhere.symlink_to(tmp_path / "mine")
    assert {path for path, _ in store.list_unreferenced()} == {circle, elsewhere}
    for path, _ in store.list_unreferenced():
        store.remove(path)
    assert store.list_unreferenced() == []
    assert artifact.verify(tmp_path / "mine")


@pytest.mark.parametrize(
    "name", ["../elsewhere", "/elsewhere", ".", "..", ".hidden", "a/b", "", "a\0b"]
)
def test_links_and_heads_never_lead_out_of_the_work_folder(work, name):
    before = sorted(work.parent.rglob("*"))
    for named in (lambda: store.link(name, {}), lambda: heads.folder(name)):
        with pytest.raises(ConfigError, match="cannot name a"):
            named()
    assert sorted(work.parent.rglob("*")) == before


@pytest.mark.parametrize("key", ["/tmp/elsewhere", "../../../elsewhere", "", "abc"])
def test_a_folder_s_manifest_cannot_say_where_its_copy_goes(work, tmp_path, key):
    folder = tmp_path / "knowledge"
    with artifact.publish(folder, Manifest("chebsplat.knowledge/4", key_of("a"), "teach")):
        pass
    file = folder / "artifact.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"key": key}))
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match="damaged: key"):
        store.import_artifact(folder, "teach", "chebsplat.knowledge/4", running=True)
    assert sorted(tmp_path.rglob("*")) == before
    assert not os.path.lexists("/tmp/elsewhere")
