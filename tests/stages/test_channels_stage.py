"""The channels are the teacher's: every scene of a teacher shares them, and nothing of a scene
changes them.
"""

import hashlib
import shutil

import numpy as np
import pytest
from shared import ROOT, run_stage
from tiny_teachers import color_reference, color_teacher, write_settings, write_table

from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.channels import ChannelMap
from chebsplat.formats.images import SUFFIXES
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.stages import channels
from chebsplat.stages.channels import generated, shipped
from chebsplat.stages.settings import ChannelsSection


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """(model, reference) of a teacher whose 6 channels span 3."""
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.delenv("REPLICA_ROOT", raising=False)
    monkeypatch.chdir(ROOT)
    rng = np.random.default_rng(0)
    mixing = np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :3]
    model = color_teacher(tmp_path, weights=mixing)
    write_table(
        tmp_path / "tiny.npz",
        embeddings=np.array([[1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) @ mixing.T,
    )
    return model, color_reference(tmp_path / "reference")


def reduced(tmp_path, model, reference, **settings):
    values = {
        "model": str(model),
        "reference": None if reference is None else str(reference),
    } | settings
    code = run_stage(
        "channels", tmp_path / "out", {}, {"channels": {k: v for k, v in values.items() if v}}
    )
    return code, ChannelMap.read(tmp_path / "out") if code == 0 else None


def test_a_teacher_is_reduced_to_the_channels_that_its_features_span(tmp_path, tiny):
    code, found = reduced(tmp_path, *tiny)
    assert code == 0
    assert found.matrix.shape == (6, 3)
    assert found.energy[2] == pytest.approx(1)
    assert (found.notes["n_pixels"], found.notes["n_words"], found.notes["n_images"]) == (
        2 * 12 * 16,
        3,
        2,
    )
    facts = read_manifest(tmp_path / "out", ChannelMap.SCHEMA).facts
    assert (facts["n_channels"], facts["of"], facts["label_agreement"]) == (3, 6, 1.0)
    assert facts["relative_error"] < 1e-3


def test_fewer_channels_lose_what_the_facts_say(tmp_path, tiny):
    _, found = reduced(tmp_path, *tiny, n_channels=2)
    facts = read_manifest(tmp_path / "out", ChannelMap.SCHEMA).facts
    assert found.matrix.shape == (6, 2)
    assert facts["relative_error"] == pytest.approx((1 - found.energy[1]) ** 0.5, rel=1e-4)
    assert 0.05 < facts["relative_error"] < 1
    assert facts["label_agreement"] > 0.95  # three words differ in two directions


def test_a_teacher_without_a_table_is_reduced_by_energy_alone(tmp_path, tiny):
    model, reference = tiny
    tokens = model.with_name("tokenizer.json")
    tokens.write_text("{}")
    write_settings(model, multiple=4, labels=None, text=model.name, tokenizer=tokens.name)
    code, _ = reduced(tmp_path, model, reference)
    assert code == 0
    facts = read_manifest(tmp_path / "out", ChannelMap.SCHEMA).facts
    assert "vocabulary" in facts["left_out"]
    assert facts["n_words"] == 0


def test_a_map_beside_its_teacher_is_taken_as_long_as_it_is_of_the_same_files_and_settings(
    tmp_path, tiny
):
    model, reference = tiny
    _, computed = reduced(tmp_path, model, reference)
    brought = model.with_suffix(".channels")
    (tmp_path / "out").rename(brought)
    settings = model.with_suffix(".toml")
    for is_taken in (True, False):
        code, found = reduced(tmp_path, model, reference)
        assert code == 0
        facts = read_manifest(tmp_path / "out", ChannelMap.SCHEMA).facts
        assert ("reference images" in facts.get("left_out", {})) == is_taken
        assert (facts["n_channels"], facts["n_images"]) == (3, 2)
        assert (
            np.array_equal(found.matrix, computed.matrix)
            and found.notes["digest"] == facts["digest"]
        )
        shutil.rmtree(tmp_path / "out")
        settings.write_text(settings.read_text() + "# another teacher from here on")
    _, fewer = reduced(tmp_path, model, reference, n_channels=2)
    assert fewer.matrix.shape == (6, 2)


def test_a_damaged_map_beside_its_teacher_is_named(tmp_path, tiny, capsys):
    model, reference = tiny
    reduced(tmp_path, model, reference)
    brought = model.with_suffix(".channels")
    (tmp_path / "out").rename(brought)
    (brought / "matrix/c.0.0").write_bytes(b"?")
    assert reduced(tmp_path, model, reference)[0] == 3
    assert str(brought / "matrix/c.0.0") in capsys.readouterr().err


def test_the_embedded_teacher_brings_its_map():
    teacher = read_teacher(EMBEDDED)
    assert shipped(teacher, ChannelsSection()) == teacher.channels
    assert shipped(teacher, ChannelsSection(n_channels=8)) is None


@pytest.mark.slow
def test_the_map_that_ships_is_what_its_stage_computes(tmp_path, monkeypatch):
    monkeypatch.setattr(channels, "shipped", lambda *_: None)
    assert run_stage("channels", tmp_path / "out", {}, {}) == 0
    computed, brought = (
        ChannelMap.read(tmp_path / "out"),
        ChannelMap.read(read_teacher(EMBEDDED).channels),
    )
    products = computed.matrix.T @ brought.matrix  # of unit columns; processors round differently
    assert np.abs(products - np.eye(len(products))).max() < 1e-3
    assert computed.notes == brought.notes


@pytest.mark.parametrize(
    "bad", ["empty folder", "not an image", "other channels", "zero word", "closed set"]
)
def test_what_cannot_be_reduced_is_named(tmp_path, tiny, bad, capsys):
    model, reference = tiny
    named = reference
    if bad == "empty folder":
        for image in reference.iterdir():
            image.unlink()
    elif bad == "not an image":
        named = reference / "a.png"
        named.write_text("hello")
    elif bad in ("other channels", "zero word"):
        named = tmp_path / "tiny.npz"
        write_table(named, embeddings=np.eye(3, 5) if bad == "other channels" else np.zeros((3, 6)))
    else:
        write_settings(model, output="logits")
        named = model.with_suffix(".toml")
    code, _ = reduced(tmp_path, model, reference)
    assert code == (2 if bad == "closed set" else 3)
    assert str(named) in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_reference_rooms_are_the_same_every_time():
    digests = [
        [hashlib.sha256(image.tobytes()).digest() for _, image in generated(range(8000, 8001))]
        for _ in "ab"
    ]
    assert digests[0] == digests[1]
    assert len(set(digests[0])) == len(digests[0]) > 1


def key(planner, scene, settings, stage="channels"):
    return next(step.key for step in planner.plan(scene, settings).steps if step.stage == stage)


def test_scenes_share_channels_which_only_their_teacher_changes(tmp_path, tiny):
    planner, (model, reference) = Planner(), tiny
    settings = f"teacher.kind=onnx,teacher.model={model}"
    shared = key(planner, "toy", settings)
    changes = [
        "source.seed=7",
        "ingest.test_every=5",
        "train.steps=9",
        "teacher.downscale=8",
        "teacher.flips=true",
    ]
    assert {key(planner, scene, settings) for scene in ("office0", "room0")} == {shared}
    assert {key(planner, "toy", f"{settings},{change}") for change in changes} == {shared}
    assert key(planner, "toy", f"{settings},channels.n_channels=2") != shared
    of_photos = key(planner, "toy", f"{settings},channels.reference={reference}")
    (reference / f"again{SUFFIXES[-1]}").write_bytes((reference / "0.png").read_bytes())
    assert (
        len({shared, of_photos, key(planner, "toy", f"{settings},channels.reference={reference}")})
        == 3
    )
    before = key(planner, "toy", settings, "teacher")
    write_table(tmp_path / "tiny.npz", embeddings=np.eye(3, 6))
    assert key(planner, "toy", settings) != shared
    assert key(planner, "toy", settings, "teacher") != before


def test_a_closed_set_teacher_and_labels_keep_their_channels(tiny):
    model, _ = tiny
    assert "channels" in Planner().plan("toy").left_out
    write_settings(model, output="logits")
    plan = Planner().plan("toy", f"teacher.kind=onnx,teacher.model={model}")
    assert "closed-set" in plan.left_out["channels"]
    assert all("channels" not in step.inputs for step in plan.steps)
