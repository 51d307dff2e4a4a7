"""The wheel holds everything under one name."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from shared import ROOT

LINKS = ("formats", "pipelines", "stages", "teachers")
OF_A_CHECKOUT = {
    f"chebsplat/{name}"
    for name in (
        "pipelines/cuda-packages.txt",
        "pipelines/setup.sh",
        "teachers/README.md",
        "teachers/quality.md",
    )
}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of the checkout that builds leave their files in."""

    def ignored(folder, names):
        here = {"work", "build", "tests", ".git", ".venv"} if folder == str(ROOT) else set()
        return (here & set(names)) | shutil.ignore_patterns(".*", "*.egg-info", "__pycache__")(
            folder, names
        )

    return shutil.copytree(
        ROOT, tmp_path_factory.mktemp("wheel") / "source", symlinks=True, ignore=ignored
    )


def build(source, *kind):
    """What `python -m build` makes of a folder."""
    command = [
        sys.executable,
        "-m",
        "build",
        *kind,
        "--no-isolation",
        "--outdir",
        f"{source}-dist",
        str(source),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return Path(f"{source}-dist")


@pytest.fixture(scope="module")
def built(source):
    return build(source)


@pytest.fixture(scope="module")
def wheel(built):
    return next(built.glob("*.whl"))


def with_plain_files(source, target):
    """A copy in which the links are files, as where a zip is unpacked by what knows no links."""
    shutil.copytree(source, target, symlinks=True)
    for name in LINKS:
        (target / "chebsplat" / name).unlink()
        (target / "chebsplat" / name).write_text(f"../{name}")
    return target


def test_an_sdist_and_a_zip_without_links_hold_what_the_wheel_holds(source, built, wheel, tmp_path):
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        held = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    files = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert files <= held
    again = next(build(with_plain_files(source, tmp_path / "unpacked"), "--wheel").glob("*.whl"))
    assert zipfile.ZipFile(again).namelist() == zipfile.ZipFile(wheel).namelist()


def test_setup_puts_links_in_the_place_of_files_and_says_so_in_one_line(source, tmp_path):
    checkout = with_plain_files(source, tmp_path / "checkout")
    nowhere = os.environ | {"PYTHON": "/nowhere/python"}  # ends it there
    done = subprocess.run(
        ["bash", "pipelines/setup.sh"], cwd=checkout, env=nowhere, capture_output=True, text=True
    )
    assert "is a file where a link belongs" in done.stderr.splitlines()[0]
    assert [(checkout / "chebsplat" / name).readlink() for name in LINKS] == [
        Path("..") / name for name in LINKS
    ]


def test_a_wheel_holds_every_file_of_every_layer_under_chebsplat_and_nothing_else(source, wheel):
    folders = {"chebsplat": source / "chebsplat"} | {
        f"chebsplat/{name}": source / name for name in LINKS
    }
    wanted = {
        f"{place}/{path.relative_to(folder).as_posix()}"
        for place, folder in folders.items()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == wanted - OF_A_CHECKOUT


USE = """
import sys, chebsplat
assert chebsplat.__file__.startswith(sys.argv[1]), chebsplat.__file__
scene = chebsplat.load(sys.argv[2])
shown = scene.render(scene.cameras[0])
assert shown.color.std() > 0 and shown.labels.shape == shown.depth.shape
print(scene.query(scene.label_names[0], against=scene.label_names[1:]).shape == (len(scene),))
"""


@pytest.mark.slow
@pytest.mark.xdist_group("toy")
def test_an_installed_wheel_opens_renders_and_asks_a_scene_from_another_folder(
    wheel, toy, tmp_path
):
    """All but the wheel itself comes from where the tests run: its dependencies take gigabytes."""
    place, folder = tmp_path / "site", tmp_path / "scene"
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-deps",
        "--no-index",
        "--target",
        str(place),
        str(wheel),
    ]
    subprocess.run(command, check=True, capture_output=True)
    folder.mkdir()
    for stage in ("export", "teacher"):
        (folder / stage).symlink_to(toy[stage])
    environment = os.environ | {"PYTHONPATH": str(place)}
    command = [sys.executable, "-P", "-c", USE, str(place), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "True"


def archived(built, tmp_path):
    """The repository as a zip, its links kept."""
    path = tmp_path / "project.zip"
    subprocess.run(["git", "archive", "--format=zip", "-o", path, "HEAD"], cwd=ROOT, check=True)
    return str(path)


SOURCES = {
    "wheel": lambda built, _: str(next(built.glob("*.whl"))),
    "sdist": lambda built, _: str(next(built.glob("*.tar.gz"))),
    "zip": archived,
    "git": lambda built, _: f"git+file://{ROOT}",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SOURCES)
def test_an_installation_runs_toy_without_setup(kind, built, tmp_path):
    """All but chebsplat itself comes from where the tests run: its dependencies take gigabytes."""
    if kind in ("zip", "git") and not (ROOT / ".git").exists():
        pytest.skip("not a checkout")
    place, source = tmp_path / "site", SOURCES[kind](built, tmp_path)
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
    ]
    subprocess.run([*command, "--target", str(place), source], check=True, capture_output=True)
    environment = os.environ | {"PYTHONPATH": str(place), "CHEBSPLAT_WORK": str(tmp_path / "work")}
    command = [
        sys.executable,
        "-P",
        "-m",
        "chebsplat.pipelines.cli",
        "run",
        "--scene",
        "toy",
        "--stage",
        "export",
    ]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    ply = tmp_path / "work/toy/export/scene.ply"
    assert ply.stat().st_size > 100_000
