"""Three newcomers type the commands of README and usage: photos of a phone, the named scene, and a
splat that somebody else trained.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.util import find_spec

import pytest
from PIL import Image
from served import served
from shared import ROOT, run_stage
from tiny_teachers import COLORS, color_teacher

from chebsplat.formats.capture import Capture
from chebsplat.formats.extras import EXTRAS
from chebsplat.formats.onnx_files import model_sha256

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("users")]
COMMAND = re.compile(r"^    (?:\.venv/bin/)?((?:chebsplat|make) .*?)(?:\s+# .*)?$", re.MULTILINE)
# what a test cannot ask for: other people's files, the network, a cluster, hours, another device
ELSEWHERE = re.compile(
    r"get-teacher|lseg|segformer|knowledge=flat|forget|FILE|rebuild|quality=|\bmethod\b|ablation|"
    r"sequence|device=|make (?:test|lint|lock|gpu|stability|setup|bench)|on=slurm|clean-stale| rm |"
    r"seconds=|-v run|stage=sfm"
)
ABSENT = {name for package, name in EXTRAS.items() if find_spec(package) is None}
PHOTO_STEPS = "train.steps=150,sfm.max_points=4000"


def commands(page):
    return [
        text for text in COMMAND.findall((ROOT / page).read_text()) if not ELSEWHERE.search(text)
    ]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder to type commands in, with photos of a room in it as a phone leaves them."""
    folder = tmp_path_factory.mktemp("users")
    config = {
        "source": {"kind": "generated", "preset": "room", "seed": 3},
        "ingest": {"max_views": 40},
    }
    assert run_stage("ingest", folder / "room", {}, config) == 0
    (folder / "photos").mkdir()
    for k, image in enumerate(Capture.read(folder / "room").images[:]):
        Image.fromarray(image).save(folder / f"photos/IMG_{k:04d}.JPG", quality=92)
    return folder


def adapted(text, names):
    """The words of a command of a page, with names of ours for those there."""
    for old, new in names.items():
        text = re.sub(rf"(?<![\w.-]){re.escape(old)}(?![\w-])", new, text)
    return shlex.split(text)


def typed(place, text, **names):
    """Exit code and output of a command of a page, in the place."""
    parts = adapted(text, names)
    run = (
        ["make", "-C", str(ROOT), *parts[1:]]
        if parts[0] == "make"
        else [sys.executable, "-P", "-m", "chebsplat.pipelines.cli", *parts[1:]]
    )
    given = os.environ | {"CHEBSPLAT_WORK": str(place / "work"), "BROWSER": "true"}
    done = subprocess.run(run, cwd=place, capture_output=True, text=True, env=given, timeout=900)
    return done.returncode, done.stdout + done.stderr


def check(place, texts, **names):
    """All of them end well, and leave what their --out names; or a line asks for an extra."""
    wrong = []
    for text in texts:
        parts = adapted(text, names)
        out = place / parts[parts.index("--out") + 1] if "--out" in parts else None
        assert out is None or out.resolve().is_relative_to(place)
        for old in () if out is None else (out, out.with_suffix(".npz")):
            shutil.rmtree(old, ignore_errors=True)
            old.unlink(missing_ok=True)
        code, output = typed(place, text, **names)
        last = output.strip().splitlines()[-1] if output.strip() else ""
        needs = re.search(r"needs the extra `(\w+)`", output)
        missing = code == 2 and needs and needs[1] in ABSENT
        if not missing and (code != 0 or not last or (out is not None and not out.exists())):
            wrong.append(f"{text}: exit {code}: {last}")
        if "Traceback" in output:
            wrong.append(f"{text}: Traceback")
    assert not wrong, "\n".join(wrong)


def test_who_has_photos_gets_a_scene_of_colours_and_names_it_as_its_last_lines_say(place):
    photos = f"{place}/photos/"
    texts = [text for text in commands("README.md") if "path/to/folder" in text]
    assert len(texts) == 2
    for text in texts:
        code, output = typed(place, f"{text} set={PHOTO_STEPS}", **{"path/to/folder/": photos})
        assert code == 0, output[-2000:]
    assert re.search(r"report.*\.html", output) and "teacher" in output
    told = re.search(r"the same command with set=(teacher\.model)=MODEL\.onnx,(\S+)", output)
    code, output = typed(place, "chebsplat query photos sofa")
    assert code == 2 and "get-teacher" in output and f"MODEL.onnx,{told[2]}" in output
    (place / "web").mkdir()
    model = color_teacher(place / "web", output="logits", labels="colors.txt")
    (place / "web/colors.txt").write_text("\n".join(COLORS) + "\n")
    with served(place / "web") as server:
        command = f"chebsplat get-teacher {server}/{model.name} --sha256 {model_sha256(model)}"
        code, output = typed(place, command)
    assert code == 0, output
    settings = f"{PHOTO_STEPS},{told[1]}={place}/tiny/tiny.onnx,{told[2]}"
    code, output = typed(place, f"make scene={photos} set={settings}")
    assert code == 0, output[-2000:]
    ran = re.search(r"to run: (.*?)   fresh", output)[1].split()
    assert {"teacher", "lift", "export"} <= {*ran} and not {"sfm", "train"} & {*ran}
    scene = re.search(r"(\S+)/report/report\.html", output)[1]
    code, output = typed(place, f"chebsplat query {scene} red")
    assert code == 0 and "red" in output, output


@pytest.fixture(scope="module")
def named(place):
    """The place, with the named scene run and a splat beside as somebody else would send it."""
    code, output = typed(place, "make scene=toy")
    assert code == 0, output[-2000:]
    shutil.copy(place / "work/toy/export/scene.ply", place / "theirs.ply")
    return place


def test_who_runs_the_named_scene_can_look_at_it_ask_it_and_take_of_it(named):
    texts = [
        text
        for page in ("README.md", "docs/usage.md")
        for text in commands(page)
        if "office0" in text
    ]
    assert len(texts) > 15
    names = {"office0": "toy", "sofa": "wall", "couch": "wall", "1280x960": "64x48"}
    check(named, texts, **names)


def test_who_has_a_splat_alone_can_look_at_it_and_name_it(named):
    splat = re.compile(r"(theirs|any)\.ply")
    pages = "README.md", "docs/usage.md"
    texts = [text for page in pages for text in commands(page) if splat.search(text)]
    assert len(texts) >= 4
    check(named, texts, office0="toy", **{"any.ply": "theirs.ply"})
