"""One way to say which scene is meant, whatever the command."""

import re
from pathlib import Path
from shlex import quote

import pytest
from click.testing import CliRunner
from shared import finish, photo_folder

from chebsplat.errors import ConfigError, InputError
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.work import store
from chebsplat.pipelines.work.finished import artifact_of, artifacts, scene_folder


@pytest.fixture(autouse=True)
def work(quick_plans):
    return quick_plans


def run(scene, settings=""):
    plan = Planner(running=True).plan(scene, settings)
    finish(plan)
    store.link(plan.title, plan.targets)
    return plan


def test_a_scene_is_meant_by_its_name_its_photos_its_links_or_its_artifact(tmp_path, work):
    scene = photo_folder(tmp_path / "a/images")
    plan = run(scene)
    title, export = plan.title, f"work/{plan.title}/export"
    for meant in (
        title,
        scene,
        "a/images",
        f"work/{title}",
        f"{work / title}/",
        plan.targets["export"],
        export,
    ):
        assert scene_folder(str(meant)).resolve() == work / title
        assert artifact_of(str(meant), "export").resolve() == plan.targets["export"]
    assert {path.resolve() for path in artifacts(title)} == set(plan.targets.values())
    assert artifacts(export) == [Path(export)]


def test_a_scene_of_several_settings_must_be_named_in_full(tmp_path):
    scene = photo_folder(tmp_path / "images")
    title = run(scene, "train.steps=5").title
    name = title.partition("@")[0]
    assert scene_folder(scene).name == scene_folder(name).name == title
    run(scene, "train.steps=6")
    with pytest.raises(ConfigError, match=rf"{name}@train\.steps=5, {name}@train\.steps=6"):
        scene_folder(scene)
    run(scene)
    assert scene_folder(scene).name == name


@pytest.mark.parametrize(
    ("meant", "error", "message"),
    [
        ("tyo", ConfigError, "there is toy"),
        ("", ConfigError, "there is toy"),
        ("a\nb", ConfigError, r"'a\\nb'"),
        ("x" * 300, ConfigError, "there is toy"),
        ("office0", ConfigError, "make scene=office0"),
        ("work/nowhere", InputError, "is missing"),
        ("photos", InputError, "run it first: make scene=photos"),
        ("Anna's $5", InputError, re.escape("make scene=" + quote("Anna's $5"))),
        ("~nobody-of-this-name", ConfigError, "there is toy"),
    ],
)
def test_what_is_no_scene_is_an_error_that_says_what_there_is(tmp_path, meant, error, message):
    run("toy")
    photo_folder(tmp_path / "photos")
    photo_folder(tmp_path / "Anna's $5")
    with pytest.raises(error, match=message):
        scene_folder(meant)


def test_an_unfinished_scene_says_how_to_finish_it(tmp_path, work):
    run("toy")
    (work / "toy/export").unlink()
    with pytest.raises(ConfigError, match=r"has no export.*make scene=toy"):
        artifact_of("toy", "export")


def test_rubbish_in_work_is_no_scene(work):
    run("toy")
    (work / "file").write_text("x")
    (work / "empty").mkdir()
    (work / "loop").symlink_to("loop")
    (work / "dangling").mkdir()
    (work / "dangling/train").symlink_to("nowhere")
    (work / "dangling/loop").symlink_to("loop")
    (work / "store/train/loop").symlink_to("loop")
    (work / "store/file").write_text("x")
    for command in (["ls"], ["clean-stale"], ["scenes"]):
        done = CliRunner().invoke(main, command)
        assert done.exit_code == 0, done.output
        assert "dangling" not in done.stdout
    assert CliRunner().invoke(main, ["clean-stale", "--yes"]).exit_code == 0
    assert not (work / "store/train/loop").is_symlink()


def test_ls_tells_of_each_scene_even_of_a_damaged_one(tmp_path, work):
    run("toy")
    plan = run(photo_folder(tmp_path / "a/images"))
    (plan.targets["train"] / "artifact.json").write_text("{")
    lines = CliRunner().invoke(main, ["ls"]).stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["scene", plan.title, "toy"]
    assert str(tmp_path / "a/images") in lines[1]


def test_rm_removes_a_scene_and_what_only_it_names(work):
    one, other = run("toy"), run("toy", "train.steps=9")
    (work / "toy/view.html").write_text("a page")
    listed = CliRunner().invoke(main, ["rm", "toy"])
    assert (listed.exit_code, str(one.targets["train"]) in listed.stdout) == (0, True)
    assert str(one.targets["ingest"]) not in listed.stdout  # the other's, too
    assert all(map(store.is_fresh, one.targets.values()))
    assert CliRunner().invoke(main, ["rm", "toy", "--yes"]).exit_code == 0
    assert not (work / "toy").exists()
    assert all(map(store.is_fresh, other.targets.values()))
    assert not store.is_fresh(one.targets["train"])
    assert store.list_unreferenced() == []


def test_rm_keeps_what_is_not_ours(tmp_path, work):
    scene = photo_folder(tmp_path / "a/images")
    folder = work / run(scene).title
    (folder / "notes.txt").write_text("mine")
    done = CliRunner().invoke(main, ["rm", scene, "--yes"])
    assert "notes.txt" in done.stdout
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_rm_removes_nothing_outside_work(tmp_path, work):
    plan = run("toy")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "train").symlink_to(plan.targets["train"])
    done = CliRunner().invoke(main, ["rm", "./elsewhere", "--yes"])
    assert done.exit_code == 3
    assert (elsewhere / "train").is_symlink()
    done = CliRunner().invoke(main, ["rm", "work/toy/train", "--yes"])
    assert (done.exit_code, "name toy" in done.stderr) == (2, True)
    assert (work / "toy/train").is_symlink()
