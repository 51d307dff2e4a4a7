"""The set-up takes the newest Python it can use; a renamed or copied clone is set up anew."""

import os
import shutil
import subprocess
from functools import partial

import pytest
from shared import ROOT

# What `python3.11` and .venv/bin/python do here: a venv that says where it was made, and nothing
# else; no downloads.
PYTHON = """#!/bin/bash
here=$(pwd -P)
[ -z "$CALLS" ] || echo "$*" >> "$CALLS"
case "$*" in
  "-m venv .venv")
    mkdir -p .venv/bin .venv/site/open3d
    cp "$0" .venv/bin/python
    printf '#!%s/.venv/bin/python\\n' "$here" > .venv/bin/chebsplat
    printf 'home = /usr/bin\\ncommand = /usr/bin/python3.11 -m venv %s/.venv\\n' "$here" \\
      > .venv/pyvenv.cfg ;;
  *purelib*) echo .venv/site ;;
  *"cuda is None"*) exit ${CPU_TORCH:-0} ;;
  *sys.version_info*) echo cp${TAG:-311} ;;
  --version) echo "Python of the test" ;;
  *ensurepip*) exit ${NO_VENV:-0} ;;
esac
"""


@pytest.fixture
def clone(tmp_path):
    """A checkout with the real Makefile and set-up, and a Python that installs nothing."""
    folder = tmp_path / "a clone"
    (folder / "pipelines").mkdir(parents=True)
    for name in ("Makefile", "pipelines/setup.sh", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, folder / name)
    (tmp_path / "bin").mkdir()
    for name in ("python3.11", "python3"):
        (tmp_path / "bin" / name).write_text(PYTHON)
        (tmp_path / "bin" / name).chmod(0o755)
    return folder


def run(folder, *command, **variables):
    environment = os.environ | {"PATH": f"{folder.parent}/bin:{os.environ['PATH']}"} | variables
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment)


def make(folder, *targets):
    done = run(folder, "make", *targets)
    assert done.returncode == 0, done.stderr
    return done.stderr


def made_in(folder):
    return (
        (folder / ".venv/bin/chebsplat")
        .read_text()
        .strip()
        .removeprefix("#!")
        .removesuffix("/.venv/bin/python")
    )


def test_setting_up_twice_does_nothing_the_second_time(clone):
    assert "setup: ready" in make(clone, "setup")
    assert make(clone, "setup") == ""


@pytest.mark.parametrize(
    "change", [os.rename, partial(shutil.copytree, symlinks=True)], ids=["renamed", "copied"]
)
def test_a_renamed_or_copied_clone_makes_its_venv_anew(clone, change):
    make(clone, "setup")
    assert made_in(clone) == str(clone)
    other = clone.with_name("another clone")
    change(clone, other)
    assert f"was made for {clone}/.venv" in make(other, "setup")
    assert made_in(other) == str(other)
    assert make(other, "setup") == ""


def test_a_venv_of_another_making_is_left_alone(clone):
    make(clone, "setup")
    # does not say where it was made
    (clone / ".venv/pyvenv.cfg").write_text("home = /usr/bin\nuv = 0.13\n")
    assert make(clone, "setup") == ""
    shared = clone.with_name("shared")
    os.rename(clone / ".venv", shared)
    (shared / "pyvenv.cfg").write_text(f"command = /usr/bin/python3.11 -m venv {shared}\n")
    (clone / ".venv").symlink_to(shared)
    assert make(clone, "setup") == ""


def python(clone, name, tag, pip="", venv=True):
    """A Python `name` of version `tag` beside the others on the PATH; `pip`: where its pip looks
    for wheels.
    """
    file = clone.parent / "bin" / name
    lines = f"#!/bin/bash\nexport TAG={tag} NO_VENV={int(not venv)}\n"
    if pip:
        lines += f'[[ "$*" == *find-links* ]] && echo "{pip}" && exit\n'
    file.write_text(
        PYTHON.replace(
            "#!/bin/bash\n", lines + f'[ "$1" = --version ] && echo "Python {tag}" && exit\n'
        )
    )
    file.chmod(0o755)


def test_the_newest_supported_python_that_can_make_a_venv_is_taken(clone):
    python(clone, "python3.13", 313, venv=False)
    python(clone, "python3.12", 312)
    python(clone, "python3", 314)
    done = run(clone, "bash", "pipelines/setup.sh")
    assert done.returncode == 0, done.stderr
    assert "making .venv with Python 312" in done.stderr


def test_a_torch_that_pip_finds_in_a_folder_decides_for_the_python_it_is_built_for(clone, tmp_path):
    (tmp_path / "torch-2.13.0+cpu-cp311-cp311-linux_x86_64.whl").touch()
    for name, tag in (
        ("python3.13", 313),
        ("python3.12", 312),
        ("python3.11", 311),
        ("python3", 313),
    ):
        python(clone, name, tag, pip=tmp_path)
    done = run(clone, "bash", "pipelines/setup.sh")
    assert "making .venv with Python 311" in done.stderr
    refused = run(clone, "bash", "-c", "rm -rf .venv; bash pipelines/setup.sh", PYTHON="python3.13")
    assert refused.returncode == 2
    assert f"the torch in {tmp_path} is not built for python3.13" in refused.stderr


def test_without_a_python_that_will_do_the_setup_says_which_and_how_to_get_one(clone):
    python(clone, "python3.10", 310)
    python(clone, "python3.12", 312, venv=False)
    done = run(clone, "bash", "pipelines/setup.sh", PYTHON="python3.10 python3.12 no-such-python")
    assert done.returncode == 2
    assert "Python 3.11, 3.12 or 3.13 is needed" in done.stderr
    assert "python3.10 is cp310" in done.stderr
    assert "apt install python3.12-venv" in done.stderr
    assert not (clone / ".venv").exists()


def installing(clone, *arguments, **variables):
    """What uv is called with by `make setup`, and how it ended."""
    calls = clone.parent / "calls"
    calls.unlink(missing_ok=True)
    done = run(clone, "make", "setup", *arguments, CALLS=str(calls), **variables)
    lines = calls.read_text().splitlines() if calls.exists() else []
    return done, [line.partition(" pip install ")[2] for line in lines if line.startswith("-m uv")]


def test_device_cuda_adds_the_cuda_torch_and_gsplat_to_what_is_there(clone):
    make(clone, "setup")
    gpu = clone.parent / "bin/nvidia-smi"
    gpu.write_text("#!/bin/bash\n")
    gpu.chmod(0o755)
    done, installed = installing(clone, "device=cuda", CPU_TORCH="1")
    assert done.returncode == 0, done.stderr
    lock, _, extra = installed
    assert "-r requirements.lock --torch-backend auto --reinstall-package torch" in lock
    assert "--constraint requirements.lock --editable .[cuda]" in extra
    lock, *_ = installing(clone, "device=cuda")[1]
    assert "--reinstall-package" not in lock  # it is a CUDA torch already
    assert installing(clone)[1] == []


def test_device_cuda_is_refused_where_there_is_no_driver(clone):
    done, installed = installing(clone, "device=cuda")
    assert done.returncode == 2 and installed == []
    assert "this machine has no NVIDIA driver" in done.stderr
    assert "none of auto, cpu, cuda" in installing(clone, "device=tpu")[0].stderr


# of whatever make calls: keeps what it is given
STUB = '#!/bin/bash\nprintf \'%s\\0\' "$@" > "$CALLS"\n'
HOSTILE = ["Anna's room", 'a "b" room', "$5 $(shell touch x) $$ `touch x`", "'; touch x; '",
           '"; touch x; '
                                                                                             ''
                                                                                             ''
                                                                                             '"',
           "a\nb", " # two  spaces \\", "-x;touch x", "*", "$(error no) ${HOME}",
           "été %s"]  # fmt: skip
CALLED = [  # goals, variables that get the name, what the command gets of it
    ([], ["scene", "set", "stage"], ["run", "--scene={}", "--set={}", "--stage={}"]),
    (
        [],
        ["sequence", "quality", "ablation"],
        ["run", "--sequence={}", "--quality={}", "--ablation={}"],
    ),
    ([], ["scene", "knowledge"], ["run", "--scene={}", "--knowledge={}"]),
    (["plan"], ["scene"], ["plan", "--scene={}", "--device=cpu"]),
    (["plan"], ["study"], ["study", "--plan", "--device=cpu", "--", "{}"]),
    ([], ["study"], ["study", "--device=cpu", "--", "{}"]),
    (["view"], ["scene"], ["view", "--", "{}"]),
    (["verify"], ["scene", "dir"], ["verify", "--", "{}", "{}"]),
    (["knowledge"], ["teacher", "out"], ["knowledge", "teach", "--teacher={}", "--out={}"]),
    (["calibration"], ["teacher"], ["calibrate", "--force", "--", "{}"]),
    ([], ["bench"], ["-m", "benchmarks", "{}"]),
]


@pytest.fixture
def stubbed(clone):
    """A clone that is set up, where Python and chebsplat keep what they are called with."""
    make(clone, "setup")
    for name in ("python", "chebsplat"):
        (clone / ".venv/bin" / name).write_text(STUB)
        (clone / ".venv/bin" / name).chmod(0o755)
    return clone


def called(clone, *arguments, **variables):
    """What the stub was given, under make with these arguments."""
    calls = clone.parent / "calls"
    done = run(clone, "make", *arguments, CALLS=str(calls), **variables)
    assert done.returncode == 0, done.stderr
    assert not list(clone.parent.rglob("x"))
    return calls.read_bytes().decode().split("\0")[:-1]


def test_names_reach_the_command_as_they_are_whatever_they_hold(stubbed):
    for goals, variables, wanted in CALLED:
        for name in HOSTILE:
            given = dict.fromkeys(variables, name)
            device = ["device=cpu"] if "--device=cpu" in wanted else []
            # make takes a leading space for its own
            text = [word.replace("{}", name.lstrip()) for word in wanted]
            assert called(stubbed, *goals, *device, *(f"{k}={v}" for k, v in given.items())) == text
    text = [word.replace("{}", HOSTILE[2]) for word in CALLED[0][2]]
    assert called(stubbed, **dict.fromkeys(CALLED[0][1], HOSTILE[2])) == text  # by the environment
    assert called(stubbed, "bench-'; touch x; '") == ["-m", "benchmarks", "'; touch x; '"]


def test_arguments_are_words_of_the_shell_and_none_of_make(stubbed):
    words = called(
        stubbed,
        "view",
        "scene=a",
        "args=--words 'my words.txt' --against \"$NAME\"",
        NAME="two words",
    )
    assert words == ["view", "--words", "my words.txt", "--against", "two words", "--", "a"]
