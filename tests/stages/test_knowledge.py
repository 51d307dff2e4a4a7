"""What a training makes of an earlier scene's basis: its weights, its regulariser, both, or neither."""

import csv

import numpy as np
import pytest
from shared import INPUTS, TOY, run_stage

from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.basis import read_basis
from chebsplat.formats.gaussians import Gaussians

pytestmark = pytest.mark.xdist_group("toy")


def train(toy, out, basis, **settings):
    """Checkpoint, facts and the columns of the trace, of a training of one step."""
    config = TOY | {"train": TOY["train"] | {"steps": 1, "report_every": 1, "encode_every": 1, "seed": 1} | settings}
    inputs = {role: toy[of] for role, of in INPUTS["train"].items()} | ({"basis": basis} if basis else {})
    assert run_stage("train", out, inputs, config) == 0
    with (out / "trace.csv").open() as handle:
        columns = next(csv.reader(handle))
    return Gaussians.read(out), read_manifest(out).facts, columns


VARIANTS = {
    "both": ({}, True, True),
    "regularise only": ({"warm_start": False}, False, True),
    "warm start only": ({"weight_basis": 0.0}, True, False),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_each_part_of_the_knowledge_is_used_where_it_is_asked_for(toy, tmp_path, variant):
    settings, warm, regularised = VARIANTS[variant]
    checkpoint, facts, columns = train(toy, tmp_path / "train", toy["cks"], **settings)
    assert ("loss_basis" in columns) == regularised
    assert ("warm_started" in facts) == warm
    assert "knowledge basis" not in facts.get("left_out", {})
    earlier, (_, weights) = read_basis(toy["cks"]).weights, checkpoint.encoder()
    apart = max(np.abs(weights[name] - earlier[name]).max() for name in earlier)
    assert (apart < 0.01) == warm  # a step of Adam moves no weight further than its rate


def test_weights_that_do_not_fit_are_named(toy, tmp_path):
    _, facts, _ = train(toy, tmp_path / "train", toy["cks"], context="none")
    said = [what for what in facts["left_out"] if what.startswith("warm start of ")]
    assert len(said) == 1 and "embed_input.weight" in said[0]


def test_a_second_revision_keeps_the_first_and_names_its_scene(toy, tmp_path):
    inputs = {"gaussians": toy["train"], "basis": toy["cks"]}
    assert run_stage("cks", tmp_path / "second", inputs) == 0
    first, second = read_basis(toy["cks"]), read_basis(tmp_path / "second")
    assert [entry["scene"] for entry in second.lineage] == ["toy", "toy"]
    assert second.lineage[:1] == first.lineage
    for name, columns in first.bases.items():
        np.testing.assert_array_equal(second.bases[name][:, : columns.shape[1]], columns)


def test_knowledge_pulls_in_the_steps_in_which_views_do(toy, tmp_path):
    settings = {"steps": 8, "encode_every": 4, "encode_from": 0.5}
    train(toy, tmp_path / "train", toy["cks"], **settings)
    with (tmp_path / "train/trace.csv").open() as handle:
        pulls = {int(float(row["step"])): float(row["loss_basis"]) > 0 for row in csv.DictReader(handle)}
    assert [step for step, pulled in pulls.items() if pulled] == [4, 8]


def test_the_modulation_is_kept_with_the_checkpoint_and_its_value_said(toy, tmp_path):
    checkpoint, facts, columns = train(toy, tmp_path / "train", toy["cks"], alpha="network")
    assert "shape.modulation.linear.weight" in checkpoint.modules
    assert 1e-3 <= facts["alpha"] <= 10 and facts["alpha"] != 1
    assert "loss_basis" in columns
    plain, plain_facts, _ = train(toy, tmp_path / "plain", toy["cks"])
    assert "alpha" not in plain_facts and not any("modulation" in name for name in plain.modules)


def test_inputs_of_another_width_leave_their_own_map_out_and_carry_its_basis_on(toy, tmp_path):
    _, facts, columns = train(toy, tmp_path / "train", toy["cks"], context="none")
    assert [what for what in facts["left_out"] if what.startswith("knowledge of ")] == ["knowledge of embed_input"]
    assert "loss_basis" in columns
    assert run_stage("cks", tmp_path / "cks", {"gaussians": tmp_path / "train", "basis": toy["cks"]}) == 0
    first, second = read_basis(toy["cks"]), read_basis(tmp_path / "cks")
    np.testing.assert_array_equal(second.bases["embed_input"], first.bases["embed_input"])
    assert second.lineage[1]["maps"].keys() == first.lineage[0]["maps"].keys() - {"embed_input"}
    assert "knowledge of embed_input" in read_manifest(tmp_path / "cks").facts["left_out"]


def test_a_revision_says_how_much_shape_varies_and_what_the_print_would_decide_by(toy):
    (entry,) = read_basis(toy["cks"]).lineage
    assert 0.1 < entry["spread"] < 10
    for report in entry["maps"].values():
        assert report["rho_printed"] == pytest.approx(report["rho"] * (1 + entry["spread"]))


def test_without_descriptors_there_is_no_spread_and_the_stage_says_so(toy, tmp_path):
    train(toy, tmp_path / "train", None, albo=False)
    assert run_stage("cks", tmp_path / "cks", {"gaussians": tmp_path / "train"}) == 0
    assert read_basis(tmp_path / "cks").lineage[0]["spread"] == 0
    assert "spread of shape" in read_manifest(tmp_path / "cks").facts["left_out"]


def test_a_basis_of_another_width_is_an_input_error(toy, tmp_path, capsys):
    inputs = {role: toy[of] for role, of in INPUTS["train"].items()} | {"basis": toy["cks"]}
    config = TOY | {"train": TOY["train"] | {"width": 16}}
    assert run_stage("train", tmp_path / "train", inputs, config) == 3
    assert "does not fit the encoder at hidden" in capsys.readouterr().err
