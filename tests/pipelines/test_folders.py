"""A folder's links have a name of their own: readable, the same always, and never another's."""

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor

import pytest
from click.testing import CliRunner
from shared import finish, photo_folder

from chebsplat.errors import ConfigError
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.work import finished, folders, inventory, store


@pytest.fixture(autouse=True)
def work(quick_plans):
    return quick_plans


def run(scene):
    """Plan a scene to run, pretend that it has, and link it."""
    plan = Planner(running=True).plan(str(scene))
    finish(plan)
    store.link(plan.title, plan.targets)
    return plan


def digits(folder):
    return hashlib.sha256(os.fsencode(folder)).hexdigest()[:4]


def test_folders_of_one_name_do_not_share_their_links_and_are_found_again(tmp_path):
    places = [tmp_path / f"{part}/images" for part in ("a", "b", "x/b")]
    titles = [run(photo_folder(folder)).title for folder in places]
    assert titles == [f"images-{digits(folder)}" for folder in places] and len(set(titles)) == 3
    assert [Planner().plan(f"{folder}/").title for folder in places] == titles
    assert [finished.scene_folder(f"{folder}").name for folder in places] == titles
    listed = {title: source for title, source, *_ in inventory.scenes()}
    assert listed == {title: str(folder) for title, folder in zip(titles, places, strict=True)}
    assert store.list_unreferenced() == []  # nothing was taken over
    assert Planner().plan(f"{places[0]}/", "train.steps=5").title == f"{titles[0]}@train.steps=5"


def test_a_folder_beside_wins_over_a_scene_of_ours_of_its_name_and_is_named(tmp_path, monkeypatch):
    photo_folder(tmp_path / "kitchen")
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, ["plan", "--scene", "kitchen"])
    assert done.exit_code == 0, done.stderr
    assert done.stdout.startswith(f"kitchen-{digits(tmp_path / 'kitchen')}: ")
    assert "kitchen is taken to be the folder here" in done.stderr
    monkeypatch.chdir(tmp_path / "kitchen")
    done = CliRunner().invoke(main, ["plan", "--scene", "toy"])
    assert done.stdout.startswith("toy: ") and "folder here" not in done.stderr


def test_a_name_of_ours_is_never_a_folder_s(tmp_path):
    for name in ("fox", "store"):
        folder = photo_folder(tmp_path / name)
        assert Planner().plan(folder).title == f"{name}-{digits(tmp_path / name)}"
    assert (
        Planner()
        .plan(photo_folder(tmp_path / "study-method"))
        .title.startswith("folder-study-method-")
    )


def test_planning_names_a_folder_and_keeps_nothing(tmp_path, work):
    assert Planner().plan(photo_folder(tmp_path / "a/images")).title.startswith("images-")
    assert not work.exists()


def test_a_name_that_stands_for_another_folder_is_an_error_that_says_for_which(tmp_path):
    name = folders.claim(tmp_path / "images")
    folders.record(name).unlink()
    folders.record(name).symlink_to("/elsewhere")
    scene = photo_folder(tmp_path / "images")
    for running in (False, True):
        with pytest.raises(ConfigError, match=f"{name} stands for /elsewhere; .* remove .*{name}"):
            Planner(running=running).plan(scene)


def test_of_folders_that_are_named_at_once_with_one_digest_one_gets_the_name(tmp_path, monkeypatch):
    same = hashlib.sha256(b"")
    monkeypatch.setattr(folders.hashlib, "sha256", lambda _: same)
    refused = []

    def claimed(place):
        try:
            folders.claim(place)
        except ConfigError:
            refused.append(place)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(claimed, [tmp_path / f"{k}/images" for k in range(8)]))
    assert len(refused) == 7


def test_a_name_fits_a_file_whatever_the_folder_is_called(tmp_path):
    for name in ("x" * 200, "沙" * 80, "a\nb", "é ü", "..."):
        found = folders.name_of(tmp_path / name)
        assert 0 < len(found.encode()) <= 80
        assert found.isprintable() and "/" not in found and not found.startswith(".")
