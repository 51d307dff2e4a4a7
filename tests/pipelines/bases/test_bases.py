"""`chebsplat basis`: what revisions say of themselves, and what is found out about a damaged one."""

import shutil

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from shared import ROOT, key_of

from chebsplat.formats import artifact, heads
from chebsplat.formats.basis import SCHEMA, Basis, read_basis, write_basis
from chebsplat.formats.manifest import Manifest
from chebsplat.pipelines.bases import revisions
from chebsplat.pipelines.cli.basis import basis as command
from chebsplat.pipelines.selection import plans
from chebsplat.pipelines.work import store
from chebsplat.shape.cks import Growth, update

NAMES = ("blocks.0.query", "blocks.0.key")
SCENES = ("office0", "room0", "office1")


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.delenv("REPLICA_ROOT", raising=False)
    monkeypatch.chdir(ROOT)
    return tmp_path / "work"


def publish(key, basis, earlier=None):
    path = store.artifact_path("cks", key)
    inputs = {} if earlier is None else {"basis": {"key": earlier, "schema": SCHEMA}}
    path.parent.mkdir(parents=True, exist_ok=True)
    with artifact.publish(path, Manifest(SCHEMA, key, "cks", inputs, {"cks": {"max_rank": 0.5}})) as tmp:
        write_basis(tmp, basis)
    return path


@pytest.fixture
def chain():
    """A HEAD called shared of three revisions, each scene of rank 2 in a room of 16 dimensions."""
    g = torch.Generator().manual_seed(0)
    grown, lineage, found = {}, [], []
    for number, scene in enumerate(SCENES, start=1):
        reports, weights = {}, {}
        for name in NAMES:
            W = torch.randn(16, 2, generator=g) @ torch.randn(2, 16, generator=g)
            before = torch.from_numpy(grown[name]) if name in grown else None
            held, reports[name] = update(before, W, Growth(energy=0.9999, n_scenes=1))
            grown[name], weights[f"{name}.weight"] = held.numpy(), W.numpy()
        lineage.append({"scene": scene, "gaussians": f"g{number}", "spread": 1.0, "maps": reports})
        earlier = key_of(number - 1) if number > 1 else None
        found.append(publish(key_of(number), Basis(dict(grown), weights, list(lineage)), earlier))
        assert heads.advance(revisions.head_folder("shared"), number - 1, found[-1])
    return found


def call(*arguments):
    """(exit code, stdout, stderr)."""
    result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    return result.exit_code, result.stdout, result.stderr


def test_log_says_which_scene_added_how_much(chain):
    code, out, _ = call("log", "shared")
    assert code == 0
    lines = out.splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [[str(k), scene] for k, scene in enumerate(SCENES, start=1)]
    assert [line.split()[2] for line in lines[1:]] == ["2.0", "4.0", "6.0"]


def test_show_names_the_columns_of_every_scene(chain):
    code, out, _ = call("show", "shared@2")
    assert code == 0
    assert out.splitlines()[0].endswith("revision 2, 2 arrays of weights")
    assert all("1-2 office0, 3-4 room0" in line and "4 of 16" in line for line in out.splitlines()[2:])
    assert "5-6 office1" in call("show", "shared")[1]


def test_diff_tells_growth_from_difference(chain):
    code, out, _ = call("diff", "shared@1", "shared")
    assert code == 0
    assert out.startswith("1 revisions in common\nshared@1 alone: none\nshared alone: room0, office1\n")
    # what has grown contains what it was, not the reverse
    assert "2 → 6  1-2           0.000                 1.000" in out
    assert "2 arrays of 2 and 2 in common, relative change" in out
    assert "relative change 0.000" in call("diff", "shared", "shared@3")[1]


def test_verify_checks_every_revision_and_names_what_is_wrong(chain, work):
    code, out, _ = call("verify", "shared")
    assert (code, out.count("digests")) == (0, 3)
    assert "continues revision 2" in out.splitlines()[2]
    shutil.rmtree(chain[0])
    code, out, _ = call("verify", f"{chain[2]}/")
    assert (code, out.splitlines()[0]) == (0, "1 office0: not in this store: nothing to check")
    assert "the revision before is not in this store" in out.splitlines()[1]


def rotated(basis):
    basis.bases[NAMES[0]] = np.ascontiguousarray(basis.bases[NAMES[0]][:, ::-1])


def another_history(basis):
    basis.lineage[0]["scene"] = "elsewhere"


def too_wide(basis):
    basis.bases[NAMES[0]] = np.eye(16, 9, dtype=np.float32)
    basis.lineage[-1]["maps"][NAMES[0]]["rank_after"] = 9


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (rotated, "does not begin with"),
        (another_history, "does not continue"),
        (too_wide, "above its ceiling of 0.5 q"),
    ],
)
def test_a_revision_that_is_no_continuation_is_an_input_error(chain, damage, message):
    forged = read_basis(chain[1])
    damage(forged)
    path = publish(key_of("forged"), forged, key_of(1))
    code, _, said = call("verify", f"{path}/")
    assert code == 3
    assert message in said


def test_what_is_exported_starts_scenes_elsewhere(chain, tmp_path, monkeypatch):
    code, out, _ = call("export", "shared@2", "--out", tmp_path / "knowledge")
    assert (code, out.strip()) == (0, str(tmp_path / "knowledge"))
    assert call("export", "shared", "--out", tmp_path / "knowledge")[0] == 2  # never overwritten
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "elsewhere"))
    asked = {"scene": "toy", "sequence": None, "settings": "", "ablation": "", "basis": f"{tmp_path}/knowledge/"}
    assert plans(**asked)[0].title == f"toy@basis={key_of(2)}"
    assert not (tmp_path / "elsewhere").exists()  # planning copies nothing
    (plan,) = plans(**asked, running=True)
    train = next(step for step in plan.steps if step.stage == "train")
    assert train.inputs["basis"] == store.artifact_path("cks", key_of(2))
    assert plan.title == f"toy@basis={key_of(2)}"
    assert read_basis(train.inputs["basis"]).lineage == read_basis(chain[1]).lineage


@pytest.mark.parametrize(("asked", "number"), [("shared@2", 2), ("shared", 3)])
def test_a_scene_starts_from_the_revision_of_a_head_that_is_named_or_the_newest(chain, asked, number):
    (plan,) = plans(scene="toy", sequence=None, settings="", ablation="", basis=asked)
    assert plan.title == f"toy@basis=shared@{number}"
    assert {step.stage for step in plan.steps if "basis" in step.inputs} == {"train"}
    assert next(step for step in plan.steps if step.stage == "train").inputs["basis"] == chain[number - 1]


def test_a_sequence_that_is_not_made_yet_says_how_to_make_it():
    code, _, said = call("log", "toys")
    assert code == 2
    assert "make sequence=toys" in said
