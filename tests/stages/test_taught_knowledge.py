"""Which knowledge of shape a scene starts from, and what teaches it."""

import json
import shutil

import numpy as np
import onnxruntime
import pytest
from furniture_library import write_library
from scipy.spatial import cKDTree
from shared import INPUTS, TOY, published, run_stage
from tiny_teachers import color_teacher, knowing_rooms

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import artifact
from chebsplat.formats.features import Features
from chebsplat.formats.knowledge import SHIPPED, read_knowledge
from chebsplat.formats.lesson import read_notes
from chebsplat.formats.teacher_model import read_teacher
from chebsplat.lifting.surface import Surface
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.planning.sequences import plan_teaching
from chebsplat.shape.point_inputs import point_inputs
from chebsplat.splats.gaussians import local_shape
from chebsplat.stages.onnx import ENCODER, first
from chebsplat.stages.recall import combine_lessons
from chebsplat.stages.registry import OF_KNOWLEDGE
from chebsplat.stages.settings import TeachSection
from chebsplat.stages.shape_models import surfaces, teaching_rooms
from chebsplat.stages.shape_models.answers import (
    TEMPERATURE,
    answered,
    confused_with,
    into_channels,
    units,
    words_by_label,
)
from chebsplat.stages.teacher_models.image_encoder import TeacherInference
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.furnished import Catalogue
from chebsplat.synthetic.layout import (
    HELD_OUT,
    KNOWLEDGE,
    MODELLED,
    REFERENCE,
    SCENES,
    TRAINING,
)


@pytest.fixture
def network(tmp_path):
    return TeacherInference(read_teacher(color_teacher(tmp_path)), 1)


def planned(settings="", scene="office0"):
    """A scene's steps by stage, and what it leaves out."""
    plan = Planner().plan(scene, settings)
    return {step.stage: step for step in plan.steps}, plan.left_out


def test_a_scene_starts_from_the_knowledge_that_ships_unless_it_is_told_not_to(quick_plans):
    shipped = artifact.read_manifest(SHIPPED).key
    steps, left_out = planned()
    assert {
        steps[of].inputs[role].name for of, role in (("refine", "knowledge"), ("encode", "start"))
    } == {shipped}
    assert set(OF_KNOWLEDGE) - steps.keys() == {"recall"} and "no lesson" in left_out["recall"]
    # by the names of its classes
    assert set(OF_KNOWLEDGE) <= planned("teacher.kind=labels")[0].keys() | {"recall"}
    for start, lost in (
        ("none", set(OF_KNOWLEDGE)),
        ("shipped", {"learn", "recall"}),
        (SHIPPED, {"learn", "recall"}),
    ):
        steps, left_out = planned(f"knowledge.start={start}")
        assert set(OF_KNOWLEDGE) - steps.keys() == lost
        assert all(left_out[stage] for stage in lost)
        assert ("knowledge" in steps["refine"].inputs) == (start != "none")


def test_where_knowledge_lies_is_no_matter_and_damage_is_noticed(quick_plans, tmp_path):
    shutil.copytree(SHIPPED, tmp_path / "mine")
    assert planned("knowledge.start=mine/")[0]["refine"].key == planned()[0]["refine"].key
    (tmp_path / "mine/weights.safetensors").write_bytes(b"x")
    with pytest.raises(InputError, match=r"weights\.safetensors"):
        planned("knowledge.start=mine/")
    with pytest.raises(ConfigError, match="cannot name a set of lessons"):
        planned("knowledge.start=.mine")


def test_another_teacher_has_none_until_it_is_taught(quick_plans, tmp_path):
    model = knowing_rooms(color_teacher(tmp_path, name="mine"))
    steps, left_out = planned(f"teacher.kind=onnx,teacher.model={model}")
    assert not steps.keys() & set(OF_KNOWLEDGE) and "knowledge" not in steps["refine"].inputs
    assert all("chebsplat knowledge teach" in left_out[stage] for stage in OF_KNOWLEDGE)
    plan = plan_teaching(Planner(), model, "teach.n_rooms=2,teach.seed=3")
    assert [step.stage for step in plan.steps] == ["channels", "teach"]
    assert (
        plan.steps[1].sections["teach"].items()
        >= {"n_rooms": 2, "seed": 3, "model": str(model)}.items()
    )
    other = plan_teaching(Planner(), None, f"teach.model={model}").steps[1].sections
    assert other["teach"]["model"] == str(model)
    closed = color_teacher(tmp_path, name="closed", output="logits")
    with pytest.raises(ConfigError, match="output is logits"):
        plan_teaching(Planner(), closed)


def test_no_room_of_knowledge_is_one_of_a_scene_a_test_or_the_teacher():
    ranges = (SCENES, REFERENCE, HELD_OUT, TRAINING, KNOWLEDGE, MODELLED)
    assert sum(map(len, ranges)) == len(set().union(*ranges))
    with pytest.raises(ValueError, match="not one for knowledge"):
        teaching_rooms.rooms_of(101, TeachSection(), None, np.eye(3))


@pytest.mark.parametrize("stretch", [1.0, 1.2])
def test_a_half_seen_room_is_what_few_photos_show_and_is_taught_all(network, monkeypatch, stretch):
    monkeypatch.setattr(teaching_rooms, "FEW_VIEWS", (2, 2.5))
    monkeypatch.setattr(teaching_rooms, "STRETCH", (stretch, stretch))
    monkeypatch.setattr(teaching_rooms, "KINDS", ("shuffled",))
    settings = TeachSection(n_views=12, n_points=3000)
    sizes = []
    for seed in KNOWLEDGE[:2]:
        whole, _, few, _ = teaching_rooms.rooms_of(seed, settings, network, np.eye(3))
        sizes.append(max(np.ptp(few.inputs.means, 0)) / max(np.ptp(whole.inputs.means, 0)))
        if stretch == 1:
            near, _ = cKDTree(few.inputs.means).query(whole.inputs.means)
            assert (near > 0.5).mean() > 0.1  # what two photos do not show
            back, row = cKDTree(whole.inputs.means).query(few.inputs.means)
            same = back < 0.1
            assert np.median(np.abs(few.n_views[same] - whole.n_views[row[same]])) <= 1
    assert (max(sizes) > 1.02) == (stretch > 1)


def test_what_ships_is_whole_small_and_says_what_it_was_taught():
    manifest = artifact.verify(SHIPPED, "chebsplat.knowledge/4")
    knowledge = read_knowledge(SHIPPED)
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 5_000_000
    assert "/" not in json.dumps(manifest.config)  # no path of the machine that taught it
    assert knowledge.card["n_rooms"] >= 64
    assert knowledge.card["held_out"]["shape"] > 0.8
    assert set(CLASS_NAMES) <= set(knowledge.words)
    np.testing.assert_allclose(knowledge.class_means[:, -1], 1, atol=1e-4)
    # no lesson adds nothing
    np.testing.assert_allclose(combine_lessons(knowledge, {}).map, knowledge.map, atol=1e-4)


@pytest.mark.xdist_group("toy")
def test_what_ships_takes_a_keyboard_for_its_desk_and_tells_all_else_that_it_was_taught(toy):
    knowledge, features = read_knowledge(SHIPPED), Features.read(toy["teacher"])
    assert knowledge.classes == list(CLASS_NAMES)
    codes = np.eye(len(CLASS_NAMES) + 1, dtype=np.float32)
    features.label_names = ["escalator", *CLASS_NAMES]  # which it was not taught
    features.label_embeddings = codes
    found = confused_with(SHIPPED, knowledge, features)
    names = features.label_names
    assert {names[k]: names[of] for k, of in enumerate(found) if of != k} == {"keyboard": "desk"}
    features.label_names, features.label_embeddings = ["escalator"], codes[:1]
    assert list(confused_with(SHIPPED, knowledge, features)) == [0]


@pytest.mark.xdist_group("toy")
def test_scenes_of_codes_meet_knowledge_through_words(toy):
    knowledge, features = read_knowledge(toy["teach"]), Features.read(toy["teacher"])
    words = [knowledge.words.index(name) for name in features.label_names]
    embeddings = units(knowledge.embeddings[words])
    answers = 3 * embeddings
    others = features.label_names[1:]
    # without a word: without a vote
    for lost, name in enumerate((f"{features.label_names[0]}_2", "thingamajig")):
        features.label_names = [name, *others]
        made = into_channels(toy["teach"], knowledge, features)(answers)
        assert made.shape == features.label_embeddings.shape
        share = np.exp(embeddings @ embeddings[lost:].T / TEMPERATURE)
        share /= share.sum(1, keepdims=True)
        np.testing.assert_allclose(made, share @ features.label_embeddings[lost:], atol=1e-4)
        learned = words_by_label(toy["teach"], knowledge, features)
        np.testing.assert_array_equal(learned.any(1), np.arange(len(words)) >= lost)
    features.label_names = [others[0], *others]  # two labels of one word: both teach it
    learned = words_by_label(toy["teach"], knowledge, features)
    assert learned.any(1).all() and (learned[0] == learned[1]).all()


@pytest.mark.xdist_group("toy")
def test_the_exported_encoder_says_what_torch_says(toy):
    knowledge = read_knowledge(toy["recall"])
    means = np.random.default_rng(0).uniform(0, 3, (400, 3))
    means[:3] += 50  # without neighbours, or next to none
    inputs = point_inputs(means, *local_shape(means, 16)[::-1], up=np.array([0, 0, 1.0]))
    runner = onnxruntime.InferenceSession(toy["onnx"] / ENCODER, providers=["CPUExecutionProvider"])
    for count in (400, 1):
        some = first(inputs, count)
        given = some._asdict() | {"neighbors": some.neighbors.astype(np.int64)}
        np.testing.assert_allclose(
            runner.run(None, given)[0], answered(knowledge, some), rtol=1e-5, atol=1e-4
        )
    assert artifact.read_manifest(toy["onnx"]).facts["largest_difference"] <= 1e-4


def refined(toy, out, config=None, **changes):
    """Facts of a refine stage of the toy with some inputs changed or, where None, left away."""
    inputs = {role: toy[of] for role, of in INPUTS["refine"].items()} | changes
    assert (
        run_stage(
            "refine", out, {role: path for role, path in inputs.items() if path is not None}, config
        )
        == 0
    )
    return artifact.read_manifest(out).facts


@pytest.mark.xdist_group("toy")
def test_labels_without_a_word_are_named_and_the_rest_of_knowledge_counts(toy, tmp_path):
    assert "knowledge" not in refined(toy, tmp_path / "a", knowledge=None)
    features = Features.read(toy["teacher"])
    for names, what in (([*features.label_names[:-1], "thingamajig"],
                         "votes of shape on some labels"),
                        ([f"thing{'amajig' * k}" for k in range(1, 1 + len(features.label_names))],
                         "knowledge of shape")):  # fmt: skip
        features.label_names = names
        other = published(tmp_path / what, features)
        facts = refined(toy, tmp_path / f"{what}, refined", features=other)
        assert "thingamajig" in facts["left_out"][what]
        assert ("knowledge" in facts) == (what != "knowledge of shape")
        inputs = {role: toy[of] for role, of in INPUTS["learn"].items()} | {"features": other}
        assert run_stage("learn", tmp_path / f"{what}, learned", inputs) == 0
        notes = read_notes(tmp_path / f"{what}, learned")
        assert ("none" in notes) == (what == "knowledge of shape")
        assert "none" in notes or notes["unnamed"] == ["thingamajig"]


@pytest.mark.xdist_group("toy")
def test_knowledge_of_another_teacher_is_refused(toy):
    features = Features.read(toy["teacher"])
    features.convention |= {"kind": "onnx", "output": "features", "teacher": "another"}
    with pytest.raises(InputError, match="the scene has another; teach knowledge for it"):
        into_channels(toy["teach"], read_knowledge(toy["teach"]), features)


def test_a_swept_room_is_what_its_photos_tell_of_depth(network, monkeypatch):
    monkeypatch.setattr(teaching_rooms, "LEAST_SWEPT", 16)
    settings = TeachSection(n_views=16, n_points=3000)
    whole, _, _, swept = teaching_rooms.rooms_of(KNOWLEDGE[1], settings, network, np.eye(3))
    assert len(swept.n_views) > 1000
    # both are about their own centroids: of floor and walls the corner is common
    middle = whole.inputs.means.max(0)
    away, _ = cKDTree(whole.inputs.means).query(
        swept.inputs.means + (middle - swept.inputs.means.max(0))
    )
    assert np.median(away) < 0.15  # spacing of the compared points, and of the corner, included
    assert (swept.n_views > 1).mean() > 0.6
    monkeypatch.setattr(
        teaching_rooms, "swept", lambda *_: Surface(np.zeros((0, 3)), np.zeros((0, 3)))
    )
    again = teaching_rooms.rooms_of(
        KNOWLEDGE[1], TeachSection(n_views=2, n_points=200), network, np.eye(3)
    )
    assert again[3] is again[0]


def test_a_room_of_modelled_pieces_is_taught_its_true_classes(network, monkeypatch, tmp_path):
    catalogue = Catalogue(write_library(tmp_path))
    monkeypatch.setattr(teaching_rooms, "catalogue", lambda: catalogue)
    embeddings = 2 * np.eye(len(CLASS_NAMES), 30)
    monkeypatch.setattr(teaching_rooms, "text_embeddings", lambda *_: embeddings)
    settings = TeachSection(n_views=10, n_points=3000)
    rooms = teaching_rooms.rooms_of(MODELLED[0], settings, network, np.eye(30))
    assert len(rooms) == 4
    for room in rooms:
        has_class = room.labels >= 0
        assert 0.5 < has_class.mean() < 1  # the kitchen's fridge is of none of our classes
        assert np.array_equal(
            room.features[has_class], np.eye(len(CLASS_NAMES), 30)[room.labels[has_class]]
        )
        assert not room.n_views[~has_class].any()
        assert (room.n_views[has_class] > 1).mean() > 0.3


@pytest.mark.xdist_group("toy")
def test_without_measured_depth_knowledge_is_asked_of_swept_depth_or_left_out(
    toy, tmp_path, monkeypatch
):
    withheld = TOY | {"ingest": {"depth": "off"}}
    assert run_stage("ingest", tmp_path / "ingest", {}, withheld) == 0
    facts = {}
    for name, dense, least in (
        ("enough", "on", 0.1),
        ("too little", "on", 0.9),
        ("none", "off", 0.1),
    ):
        monkeypatch.setattr(surfaces, "LEAST_SWEPT", least)  # the toy's photos tell a fifth
        config, made = (
            withheld | {"sfm": {"max_points": 300, "dense": dense}},
            toy | {"ingest": tmp_path / "ingest"},
        )
        for stage in ("sfm", "describe", "encode", "learn", "refine"):
            made[stage] = tmp_path / name / stage
            inputs = {role: made[of] for role, of in INPUTS[stage].items()}
            assert run_stage(stage, made[stage], inputs, config) == 0
            facts[name, stage] = artifact.read_manifest(made[stage]).facts
    assert facts["enough", "refine"]["start"] == "trained"
    # generated: metric without depth, too
    assert facts["enough", "refine"]["unit_from"] == "source"
    assert facts["enough", "refine"]["knowledge"]["of"] == "swept depth"
    assert facts["enough", "learn"]["n_points"] > 0
    for name, why in (("too little", "too little"), ("none", "were not swept")):
        for stage in ("describe", "encode", "refine"):
            assert why in facts[name, stage]["left_out"]["knowledge of shape"]
        assert why in facts[name, "learn"]["left_out"]["a lesson"]
        assert (
            facts[name, "refine"]["strength"] == facts[name, "refine"]["changed_by_knowledge"] == 0
        )
    assert artifact.read_manifest(toy["refine"]).facts["start"] == "both"
    assert artifact.read_manifest(toy["refine"]).facts["knowledge"]["of"] == "depth"
