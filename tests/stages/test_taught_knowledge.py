"""Which knowledge of shape a scene starts from, and what teaches it."""

import json
import shutil

import numpy as np
import onnxruntime
import pytest
from scipy.spatial import cKDTree
from shared import INPUTS, TOY, published, run_stage
from tiny_teachers import color_teacher, knowing_rooms

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.knowledge import ENCODER, SHIPPED, read_knowledge
from chebsplat.formats.lifted import Refined
from chebsplat.formats.teacher_model import read_teacher
from chebsplat.lifting.surface import Surface
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.planning.sequences import teaching
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.shape.point_inputs import point_inputs
from chebsplat.splats.gaussians import local_shape
from chebsplat.stages import refine
from chebsplat.stages.settings import KnowledgeSection
from chebsplat.stages.shape_models import teaching_rooms
from chebsplat.stages.shape_models.predictions import into_channels
from chebsplat.stages.teacher_models.image_encoder import TeacherInference
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import HELD_OUT, KNOWLEDGE, REFERENCE, SCENES, TRAINING


@pytest.fixture
def network(tmp_path):
    return TeacherInference(read_teacher(color_teacher(tmp_path)), 1)


def refine_of(settings="", scene="office0"):
    plan = Planner().plan(scene, settings)
    return next(step for step in plan.steps if step.stage == "refine"), plan.left_out


def test_a_scene_starts_from_the_knowledge_that_ships_unless_it_is_told_not_to(quick_plans):
    step, left_out = refine_of()
    assert step.inputs["knowledge"].name == artifact.read_manifest(SHIPPED).key
    assert "knowledge of shape" not in left_out
    step, left_out = refine_of("refine.knowledge=none")
    assert not {"knowledge", "points"} & set(step.inputs)
    assert left_out["knowledge of shape"]
    assert "knowledge" in refine_of("teacher.kind=labels")[0].inputs  # by the names of its classes
    assert "knowledge" in refine_of(f"refine.knowledge={SHIPPED}")[0].inputs


def test_where_knowledge_lies_is_no_matter_and_damage_is_noticed(quick_plans, tmp_path):
    shutil.copytree(SHIPPED, tmp_path / "mine")
    assert refine_of("refine.knowledge=mine")[0].key == refine_of()[0].key
    (tmp_path / "mine/weights.safetensors").write_bytes(b"x")
    with pytest.raises(InputError, match=r"weights\.safetensors"):
        refine_of("refine.knowledge=mine")


def test_another_teacher_has_none_until_it_is_taught(quick_plans, tmp_path):
    model = knowing_rooms(color_teacher(tmp_path, name="mine"))
    step, left_out = refine_of(f"teacher.kind=onnx,teacher.model={model}")
    assert "knowledge" not in step.inputs
    assert "chebsplat knowledge" in left_out["knowledge of shape"]
    plan = teaching(Planner(), model, "knowledge.n_rooms=2")
    assert [step.stage for step in plan.steps] == ["channels", "teach"]
    assert plan.steps[1].sections["knowledge"]["n_rooms"] == 2
    closed = color_teacher(tmp_path, name="closed", output="logits")
    with pytest.raises(ConfigError, match="output is logits"):
        teaching(Planner(), closed)


def test_no_room_of_knowledge_is_one_of_a_scene_a_test_or_the_teacher():
    ranges = (SCENES, REFERENCE, HELD_OUT, TRAINING, KNOWLEDGE)
    assert sum(map(len, ranges)) == len(set().union(*ranges))
    with pytest.raises(ValueError, match="not one for knowledge"):
        teaching_rooms.rooms_of(101, KnowledgeSection(), None, np.eye(3))


@pytest.mark.parametrize("stretch", [1.0, 1.2])
def test_a_half_seen_room_is_what_few_photos_show_and_is_taught_all(network, monkeypatch, stretch):
    monkeypatch.setattr(teaching_rooms, "FEW_VIEWS", (2, 2.5))
    monkeypatch.setattr(teaching_rooms, "STRETCH", (stretch, stretch))
    monkeypatch.setattr(teaching_rooms, "KINDS", ("shuffled",))
    settings = KnowledgeSection(n_views=12, n_points=3000)
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
    manifest = artifact.verify(SHIPPED, "chebsplat.knowledge/1")
    knowledge = read_knowledge(SHIPPED)
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 2_000_000
    assert "/" not in json.dumps(manifest.config)  # no path of the machine that taught it
    assert knowledge.card["n_rooms"] >= 64
    assert knowledge.card["held_out"]["shape"] > 0.8
    assert set(CLASS_NAMES) <= set(knowledge.words)
    assert (SHIPPED / ENCODER).is_file()


@pytest.mark.xdist_group("toy")
def test_scenes_of_codes_meet_knowledge_through_words(toy):
    knowledge, features = read_knowledge(toy["teach"]), Features.read(toy["teacher"])
    words = [knowledge.words.index(name) for name in features.label_names]
    translated = into_channels(toy["teach"], knowledge, features)
    answers = knowledge.embeddings[words].astype(np.float32)
    made = translated(answers)
    assert made.shape == features.label_embeddings.shape
    share = np.exp(10 * answers @ answers.T / np.linalg.norm(answers, axis=1)[:, None])
    share /= share.sum(1, keepdims=True)
    np.testing.assert_allclose(made, share @ features.label_embeddings, atol=1e-4)


@pytest.mark.xdist_group("toy")
def test_onnx_of_a_taught_encoder_says_what_torch_says(toy):
    knowledge = read_knowledge(toy["teach"])
    means = np.random.default_rng(0).uniform(0, 3, (400, 3))
    covariances, normals = local_shape(means, 16)
    inputs = point_inputs(means, normals, covariances, up=np.array([0, 0, 1.0]))
    wanted = PointEncoder.restored(knowledge.encoder, knowledge.weights).predict(inputs)
    runner = onnxruntime.InferenceSession(toy["teach"] / ENCODER, providers=["CPUExecutionProvider"])
    given = inputs._asdict() | {"neighbors": inputs.neighbors.astype(np.int64)}
    np.testing.assert_allclose(runner.run(None, given)[0], wanted, rtol=1e-5, atol=1e-5)
    assert artifact.read_manifest(toy["teach"]).facts["largest_difference"] < 1e-5


def refined(toy, out, config=None, **changes):
    """Facts of a refine stage of the toy with some inputs changed or, where None, left away."""
    inputs = {role: toy[of] for role, of in INPUTS["refine"].items()} | changes
    assert run_stage("refine", out, {role: path for role, path in inputs.items() if path is not None}, config) == 0
    return artifact.read_manifest(out).facts


@pytest.mark.xdist_group("toy")
def test_shape_is_told_of_depth_s_points_or_of_what_the_gaussians_show(toy, tmp_path):
    assert refined(toy, tmp_path / "a")["knowledge"]["of"] == "points"
    capture = Capture.read(toy["ingest"])
    capture.depth = None
    flat = published(tmp_path / "flat", capture)
    without = refined(toy, tmp_path / "b", capture=flat)
    assert "no depth" in without["left_out"]["knowledge of shape"]
    assert without["strength"] == without["changed_by_knowledge"] == 0
    gaussians = Gaussians.read(toy["train"])
    gaussians.parameters["logit_opacities"] = gaussians.parameters["logit_opacities"] + 5  # 24 steps leave them faint
    opaque = published(tmp_path / "opaque", gaussians)
    rendered = TOY | {"refine": {"surface": "rendered"}}
    facts = refined(toy, tmp_path / "d", rendered, capture=flat, gaussians=opaque)
    assert facts["knowledge"]["of"] == "rendered depth"
    assert facts["unit_from"] == "source"  # generated: metric without depth, too
    assert "knowledge" not in refined(toy, tmp_path / "c", knowledge=None)


@pytest.mark.xdist_group("toy")
def test_labels_without_a_word_leave_knowledge_out_and_say_so(toy, tmp_path):
    features = Features.read(toy["teacher"])
    features.label_names = ["thingamajig", *features.label_names[1:]]
    facts = refined(toy, tmp_path / "out", features=published(tmp_path / "f", features))
    assert "thingamajig" in facts["left_out"]["knowledge of shape"]
    assert facts["changed_by_knowledge"] == 0


@pytest.mark.xdist_group("toy")
def test_knowledge_of_another_teacher_is_refused(toy):
    features = Features.read(toy["teacher"])
    features.convention |= {"kind": "onnx", "output": "features", "teacher": "another"}
    with pytest.raises(InputError, match="the scene has another; teach knowledge for it"):
        into_channels(toy["teach"], read_knowledge(toy["teach"]), features)


def test_a_swept_room_is_what_its_photos_tell_of_depth(network, monkeypatch):
    monkeypatch.setattr(teaching_rooms, "LEAST_SWEPT", 16)
    settings = KnowledgeSection(n_views=16, n_points=3000)
    whole, _, _, swept = teaching_rooms.rooms_of(KNOWLEDGE[1], settings, network, np.eye(3))
    assert len(swept.n_views) > 1000
    middle = whole.inputs.means.max(0)  # both are about their own centroids: of floor and walls the corner is common
    away, _ = cKDTree(whole.inputs.means).query(swept.inputs.means + (middle - swept.inputs.means.max(0)))
    assert np.median(away) < 0.15  # spacing of the compared points, and of the corner, included
    assert (swept.n_views > 1).mean() > 0.6
    monkeypatch.setattr(teaching_rooms, "swept", lambda *_: Surface(np.zeros((0, 3)), np.zeros((0, 3))))
    again = teaching_rooms.rooms_of(KNOWLEDGE[1], KnowledgeSection(n_views=2, n_points=200), network, np.eye(3))
    assert again[3] is again[0]


@pytest.mark.xdist_group("toy")
def test_without_measured_depth_knowledge_is_asked_of_swept_depth_or_left_out(toy, tmp_path, monkeypatch):
    withheld = TOY | {"ingest": {"depth": "off"}}
    assert run_stage("ingest", tmp_path / "ingest", {}, withheld) == 0
    made = {}
    for name, dense, least in (("enough", "on", 0.1), ("too little", "on", 0.9), ("none", "off", 0.1)):
        monkeypatch.setattr(refine, "LEAST_TOLD", least)  # the toy's photos tell a fifth
        inputs, config = {"capture": tmp_path / "ingest"}, withheld | {"sfm": {"max_points": 300, "dense": dense}}
        assert run_stage("sfm", tmp_path / name / "sfm", inputs, config) == 0
        inputs = {role: toy[of] for role, of in INPUTS["refine"].items()}
        inputs |= {"capture": tmp_path / "ingest", "points": tmp_path / name / "sfm"}
        assert run_stage("refine", tmp_path / name / "refine", inputs, withheld) == 0
        made[name] = artifact.read_manifest(tmp_path / name / "refine").facts
    assert Refined.read(tmp_path / "enough/refine").notes["start"] == made["enough"]["start"] == "trained"
    assert made["enough"]["knowledge"]["of"] == "swept depth"
    left_out = {name: facts.get("left_out", {}).get("knowledge of shape", "") for name, facts in made.items()}
    assert left_out["enough"] == ""
    assert "too little" in left_out["too little"]
    assert "misleads" in left_out["none"]
    assert artifact.read_manifest(toy["refine"]).facts["start"] == "both"
    assert artifact.read_manifest(toy["refine"]).facts["knowledge"]["of"] == "points"
