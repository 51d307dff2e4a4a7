"""What there is before anything runs: names, settings, versions; and nothing is written to say
so.
"""

import os
import re
import subprocess
import sys

import pytest
from click.testing import CliRunner
from shared import ROOT, photo_folder

from chebsplat.errors import ConfigError, InputError
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.work.scenes import ONE, names, read_toml
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime import progress
from chebsplat.stages.runtime.config import known_keys


def asked(*arguments):
    return CliRunner().invoke(main, list(arguments))


def test_settings_lists_every_setting_with_its_default_range_and_meaning():
    lines = asked("settings").stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["setting", *known_keys()]
    assert not [line for line in lines if "<class" in line or len(line) > 250]
    told = asked("settings", "train.sh_degree").stdout.splitlines()[1]
    assert told.split()[:6] == ["train.sh_degree", "3", "integer,", "0", "to", "3"]
    assert "mixed | region | classic | off" in asked("settings", "train").stdout
    wrong = asked("settings", "trian")
    assert (wrong.exit_code, "did you mean train" in wrong.stderr) == (2, True)


@pytest.mark.parametrize(("flags", "level"), [([], "INFO"), (["-v"], "DEBUG")])
def test_v_shows_details_of_this_process_and_of_its_jobs(monkeypatch, flags, level):
    monkeypatch.setenv(progress.VERBOSE, "")
    assert asked(*flags, "scenes").exit_code == 0
    assert progress.log_level() == level


def test_version_names_chebsplat_and_what_it_computes_with_and_imports_none_of_it():
    script = "import sys\nfrom chebsplat.pipelines.cli import main\ntry: main(['--version'])\n"
    script += (
        "except SystemExit as stop: assert not stop.code\nassert not {'torch', 'numba'} & "
        "set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(f"{name} " in done.stdout for name in ("chebsplat", "torch", "numba", "Python"))


def test_scenes_of_private_data_are_listed_apart_and_say_what_to_set(
    quick_plans, tmp_path, monkeypatch
):
    monkeypatch.setenv("CHEBSPLAT_TEST_DATA", str(tmp_path / "data"))
    ours, apart = asked("scenes").stdout.split("scenes of data")
    assert "office0" in ours and "fox" not in ours
    assert f"{tmp_path}/data/fox" in apart and "set CHEBSPLAT_TEST_DATA" in apart
    with pytest.raises(InputError, match=f"{tmp_path}/data/fox.*set CHEBSPLAT_TEST_DATA"):
        Planner().plan("fox")
    photo_folder(tmp_path / "data/fox")
    assert "there" in asked("scenes").stdout.split("data/fox")[1].splitlines()[0]


def test_a_scene_whose_data_is_absent_can_be_given_another_folder(
    quick_plans, tmp_path, monkeypatch
):
    monkeypatch.setenv("CHEBSPLAT_TEST_DATA", str(tmp_path / "data"))
    plan = Planner().plan(
        "fox", f"source.kind=photos,source.path={photo_folder(tmp_path / 'photos')}"
    )
    assert plan.title.startswith("fox@")
    with pytest.raises(InputError, match=r"nowhere is not a folder; correct source\.path"):
        Planner().plan("fox", f"source.path={tmp_path}/nowhere")


@pytest.mark.parametrize("kind", sorted(ONE))
def test_what_has_no_name_is_called_by_its_kind(kind):
    with pytest.raises(ConfigError, match=f"no {ONE[kind]} is called nothing of the kind"):
        read_toml(kind, "nothing of the kind")
    assert names(kind)


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("scenes", 0),
        ("ls", 0),
        ("clean-stale --yes", 0),
        ("settings", 0),
        ("plan --scene toy", 0),
        ("plan --sequence toys --ablation paper", 0),
        ("study toys --plan", 0),
        ("query toy sofa", 2),
        ("verify toy", 2),
    ],
)
def test_a_command_that_only_looks_makes_no_folder(
    command, code, quick_plans, tmp_path, monkeypatch
):
    monkeypatch.delenv("CHEBSPLAT_WORK")
    done = asked(*command.split())
    assert done.exit_code == code, done.stderr
    assert code == 0 or "toy is no finished scene" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_make_says_the_code_that_it_cannot_leave_with():
    done = subprocess.run(
        ["make", "-o", ".venv/.ready", "plan", "scene=./nowhere/"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2  # GNU make's own, whatever failed
    assert "not a folder" in done.stderr and "Error 3" in done.stderr


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("chebsplat quer", "query"),
        ("chebsplat query of", "office0"),
        ("chebsplat rm office0 mi", "mine"),
        ("chebsplat run --scene room", "room0 room1 room2"),
        ("chebsplat run --scene min", ""),
        ("chebsplat plan --quality d", "draft"),
        ("chebsplat study paper", "paper-tables"),
    ],
)
def test_a_shell_completes_commands_and_names_of_scenes(words, found, quick_plans, tmp_path):
    """As docs/usage.md says; quick_plans: of a work folder of its own."""
    page = (ROOT / "docs/usage.md").read_text().replace(".venv/bin/", "")
    line = re.search(r"^    (eval .*bash_source.*?) +#", page, re.MULTILINE)
    for name in ("office0", "mine"):
        (quick_plans / name / "ingest").mkdir(parents=True)
        (quick_plans / name / "ingest/artifact.json").touch()
    typed = f"COMP_WORDS=({words}); COMP_CWORD={len(words.split()) - 1}"
    script = f'{line[1]}; {typed}; _chebsplat_completion chebsplat; echo "${{COMPREPLY[@]}}"'
    command = tmp_path / "bin/chebsplat"  # as pip makes it
    command.parent.mkdir()
    command.write_text(f"#!{sys.executable}\nfrom chebsplat.pipelines.cli import main\nmain()\n")
    command.chmod(0o755)
    there = {"PATH": f"{command.parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-c", script], env=os.environ | there, capture_output=True, text=True
    )
    assert (done.stdout.strip(), done.returncode) == (found, 0), done.stderr


def test_help_lists_every_command_once_by_what_a_user_wants():
    shown = CliRunner().invoke(main, ["--help"]).output
    listed = re.findall(r"^  ([a-z-]+)  ", shown.partition("\nRun:")[2], re.MULTILINE)
    visible = {name for name, command in main.commands.items() if not command.hidden}
    assert sorted(listed) == sorted(visible | set(STAGES))
