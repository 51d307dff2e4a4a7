"""A folder's links have a name of their own: readable, the same always, and never another's."""

import json
from concurrent.futures import ThreadPoolExecutor

import pytest
from shared import finish, photo_folder

from chebsplat.errors import ConfigError, InputError
from chebsplat.pipelines import folders, store
from chebsplat.pipelines.plan import Planner


@pytest.fixture(autouse=True)
def work(quick_plans):
    return quick_plans


def run(scene):
    """Plan a scene to run, pretend that it has, and link it."""
    plan = Planner(running=True).plan(str(scene))
    finish(plan)
    store.link(plan.title, plan.targets)
    return plan


def test_folders_of_one_name_do_not_share_their_links(tmp_path):
    first, second, third = (tmp_path / f"{part}/images" for part in ("a", "b", "x/b"))
    titles = [run(photo_folder(folder)).title for folder in (first, second, third)]
    assert titles[:2] == ["images", "b-images"]
    assert titles[2].startswith("images-") and len(titles[2]) == len("images-") + 8
    assert [Planner().plan(f"{folder}/").title for folder in (third, second, first)] == titles[::-1]
    assert store.unnamed() == []  # nothing was taken over
    assert Planner().plan(f"{first}/", "train.steps=5").title == "images@train.steps=5"


def test_a_name_of_ours_is_never_a_folder_s(tmp_path):
    for name in ("fox", "toy", "study-method", "basis-shared"):
        assert Planner().plan(photo_folder(tmp_path / "mine" / name)).title == f"mine-{name}"


def test_a_folder_of_another_in_work_is_not_taken_over(tmp_path, work):
    (work / "images").mkdir(parents=True)
    assert run(photo_folder(tmp_path / "a/images")).title == "a-images"
    assert list((work / "images").iterdir()) == []


def test_links_made_before_names_were_kept_stay_with_their_folder(tmp_path, work):
    scene = photo_folder(tmp_path / "a/images")
    plan = run(scene)
    (work / ".names/images.json").unlink()
    manifest = plan.targets["ingest"] / "artifact.json"
    held = json.loads(manifest.read_text()) | {"config": {"source": {"path": str(tmp_path / "a/images")}}}
    manifest.write_text(json.dumps(held))
    assert Planner().plan(photo_folder(tmp_path / "b/images")).title == "b-images"
    assert Planner().plan(scene).title == "images"


def test_planning_names_a_folder_and_keeps_nothing(tmp_path, work):
    assert Planner().plan(photo_folder(tmp_path / "a/images")).title == "images"
    assert Planner().plan(photo_folder(tmp_path / "b/images")).title == "images"
    assert not work.exists()


def test_a_damaged_or_exhausted_register_is_an_error_that_says_where(tmp_path, work):
    run(photo_folder(tmp_path / "a/images"))
    folders.record("images").write_text("{")
    with pytest.raises(InputError, match=r"images\.json"):
        Planner().plan(f"{tmp_path}/a/images/")
    for name in folders.candidates(tmp_path / "a/images"):
        folders.record(name).write_text(json.dumps({"source": "/elsewhere"}))
    with pytest.raises(ConfigError, match="stand for other folders"):
        Planner().plan(f"{tmp_path}/a/images/")


def test_folders_that_are_named_at_once_get_different_names(tmp_path):
    places = [tmp_path / f"{k}/images" for k in range(8)]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(folders.claim, places))
    assert len(set(found)) == len(places)
    assert [folders.name_of(place) for place in places] == found


def test_a_name_fits_a_file_whatever_the_folder_is_called(tmp_path):
    for name in ("x" * 200, "沙" * 80, "a\nb", "é ü", "..."):
        for found in folders.candidates(tmp_path / name):
            assert 0 < len(found.encode()) <= 80
            assert found.isprintable() and "/" not in found and not found.startswith(".")
