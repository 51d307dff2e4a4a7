"""Every artifact reads back what was written; every kind of damage to every file is named with its
remedy.
"""

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
import zarr
from malformed.edits import changed, cut, flipped, put, remove
from plyfile import PlyData
from shared import KEY, data, gaussian_parameters, published

from chebsplat.errors import InputError
from chebsplat.formats import (
    artifact,
    capture,
    descriptors,
    encoding,
    evaluation,
    features,
    knowledge,
    lesson,
    lifted,
    ply,
    points,
    scene,
)
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.record import StoredArray


def make_capture():
    rng = np.random.default_rng(1)
    depth = rng.random((3, 4, 5), dtype=np.float32)
    depth[0, 0, 0] = np.nan
    return capture.Capture(
        ["a", "b", "c"],
        rng.integers(0, 255, (3, 4, 5, 3), dtype=np.uint8),
        np.tile(np.eye(3), (3, 1, 1)),
        np.tile(np.eye(4), (3, 1, 1)),
        np.array([True, False, False]),
        depth,
        rng.integers(-1, 2, (3, 4, 5)).astype(np.int16),
        rng.random((3, 4, 5)) > 0.5,
        ["wall", "floor"],
        {"kind": "test"},
        {"name": "labels"},
        rng.random((7, 3), dtype=np.float32),
        rng.integers(0, 255, (7, 3), dtype=np.uint8),
        rng.integers(-1, 2, (3, 4, 5)).astype(np.int16),
        rng.random((3, 4, 5)).astype(np.float16),
    )


def make_points():
    rng = np.random.default_rng(2)
    return points.Points(
        ["a"],
        np.eye(3)[None],
        np.eye(4)[None],
        rng.normal(size=(5, 3)),
        rng.integers(0, 255, (5, 3), dtype=np.uint8),
        rng.normal(size=(5, 3)).astype(np.float32),
        np.tile(np.eye(3, dtype=np.float32), (5, 1, 1)),
        np.zeros((0, 2), np.int32),
        {"how": "depth"},
        rng.random((1, 3, 4), np.float32),
    )


def make_features():
    rng = np.random.default_rng(3)
    return features.Features(
        ["a", "b"],
        rng.normal(size=(2, 3, 4, 5)).astype(np.float16),
        ["wall", "floor"],
        np.eye(2, 5, dtype=np.float32),
        rng.integers(0, 2, (2, 3, 4)).astype(np.int16),
        rng.random((2, 3, 4)).astype(np.float16),
        {"normalized": True},
    )


def make_descriptors():
    rng = np.random.default_rng(4)
    arrays = [rng.normal(size=(5, width)).astype(np.float32) for width in (6, 3, 3, 8)]
    neighbors = rng.integers(-1, 5, (5, 4, 2)).astype(np.int32)
    return descriptors.Descriptors(
        *arrays, neighbors, [0.0, 1, 2], [0.0, 0, 1], 2.5, {"of": "depth"}
    )


def make_encoding():
    return encoding.Encoding(
        np.random.default_rng(9).normal(size=(5, 7)).astype(np.float16), {"none": "why"}
    )


def make_sums():
    z = np.random.default_rng(10).normal(size=(20, 7)).astype(np.float32)
    # what float32 holds exactly
    gram, cross = (z.T @ z).astype(np.float64), (z.T @ z[:, :3]).astype(np.float64)
    return np.tril(gram) + np.tril(gram, -1).T, cross, 1.1


def make_lesson():
    return lesson.Lesson(make_sums(), {"scene": "a", "given": True, "rho": 0.25})


def make_cameras():
    return Cameras(["a"], np.eye(3)[None], np.eye(4)[None], 5, 4)


def make_scene():
    p = gaussian_parameters()
    codes = np.random.default_rng(5).integers(-127, 128, (6, 4))
    codes[:, 0] = 127
    p["features"] = (codes / 2**15).astype(np.float32)  # what 8 bits a row hold exactly
    order = np.argsort(np.random.default_rng(6).permutation(p["degrees"]), kind="stable")
    labels = np.array([0, 1, -1, 0, 1, 1], np.int32)
    return scene.Scene(
        p,
        make_cameras(),
        order,
        labels,
        ["wall", "floor"],
        np.eye(2, 4, dtype=np.float32),
        {"left_out": {"lift": "none"}},
    )


def make_evaluation():
    rng = np.random.default_rng(6)
    pictures = {
        "renders": rng.integers(0, 255, (2, 3, 4, 3), dtype=np.uint8),
        "labels": np.zeros((2, 3, 4), np.int16),
    }
    figures = {
        "names": ["a", "b"],
        "image": {"psnr": 30.0, "ssim": 0.9, "per_view": {"psnr": [29.0, 31.0]}},
    }
    figures |= {
        "n_gaussians": 5,
        "bytes": {"ply": 7},
        "frames_per_second": {},
        "left_out": {},
        "lpips": None,
    }
    return evaluation.Evaluation(figures, pictures)


def make_agreement():
    labels = {
        "wall": {"share": 0.75, "agreement": 0.5},
        "floor": {"share": 0.25, "agreement": 0.25},
    }
    return evaluation.ViewAgreement(0.375, 40, 2, labels)


def make_lifted():
    rng = np.random.default_rng(7)
    return lifted.Lifted(
        rng.normal(size=(6, 4)).astype(np.float32),
        rng.random(6, dtype=np.float32),
        np.arange(6, dtype=np.int32),
        rng.random(6, dtype=np.float32),
        rng.normal(size=(2, 6, 4)).astype(np.float32),
        rng.integers(0, 3, (2, 6)).astype(np.int32),
        {"views": ["a", "b"], "n_observations": 9},
    )


def make_refined():
    rng = np.random.default_rng(8)
    notes = {
        "start": "trained",
        "smooth": True,
        "strength": 2.0,
        "halves": {"without": 0.8, "with": 0.9},
    }
    return lifted.Refined(
        rng.normal(size=(6, 4)).astype(np.float32), rng.random(6, dtype=np.float32), notes
    )


def make_knowledge():
    weights = {"embed.0.weight": np.random.default_rng(8).normal(size=(4, 6)).astype(np.float32)}
    matrix, answers = (
        np.eye(7, 3, dtype=np.float32),
        [np.eye(7, n, dtype=np.float32) for n in (3, 2)],
    )
    of = "a", "b", {"n_channels": 3}, weights, matrix, {"n_angles": 8}
    words = ["sofa", "wall"], np.eye(2, 3, dtype=np.float16)
    classes = np.ones(7, np.float32), ["wall"], np.ones((1, 7), np.float32)
    card = {"n_rooms": 2}, {"share": 3.0}
    return knowledge.Knowledge(*of, *words, *answers, *classes, *card, [make_sums()] * 2)


CASES = {
    "capture": make_capture,
    "points": make_points,
    "features": make_features,
    "scene": make_scene,
    "agreement": make_agreement,
    "lifted": make_lifted,
    "refined": make_refined,
    "evaluation": make_evaluation,
    "descriptors": make_descriptors,
    "encoding": make_encoding,
    "lesson": make_lesson,
    "knowledge": make_knowledge,
}
OTHERS = {  # no record of zarr's yet
    "lesson": (lesson.write_lesson, lesson.read_lesson, lesson.SCHEMA),
    "knowledge": (knowledge.write_knowledge, knowledge.read_knowledge, knowledge.SCHEMA),
}


@pytest.fixture(params=CASES)
def case(request, tmp_path):
    record, path = CASES[request.param](), tmp_path / request.param
    if request.param not in OTHERS:
        return record, type(record).read, published(path, record)
    write, read, schema = OTHERS[request.param]
    with artifact.publish(path, Manifest(schema, KEY, "s")) as tmp:
        write(tmp, record)
    return record, read, path


def same(a, b):
    if isinstance(a, Cameras):
        return same(vars(a), vars(b))
    if isinstance(a, dict):
        return set(a) <= set(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray):
        return np.array_equal(np.asarray(b), a, equal_nan=a.dtype.kind == "f")
    return a == b


def touch_all(record):
    """Read what is lazy."""
    for value in [*vars(record).values(), *getattr(record, "pictures", {}).values()]:
        if isinstance(value, StoredArray):
            value[:]


def test_an_artifact_reads_back(case):
    record, read, path = case
    found = read(path)
    for name, value in vars(record).items():
        assert same(value, getattr(found, name)), name
    artifact.verify(path)


DAMAGES = {
    "truncate": lambda name: cut(name, 1),
    "empty": lambda name: put(name, ""),
    "flip": flipped,
    "remove": remove,
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damage_to_any_file_is_named_with_its_remedy(case, damage):
    _, read, path = case
    for file in sorted(
        p
        for p in path.rglob("*")
        if p.is_file() and p.suffix not in (".ply", ".spz") and p.name != "artifact.json"
    ):
        good = file.read_bytes()
        damage(file.name)(file.parent)
        with pytest.raises(InputError, match="run its stage again") as error:
            touch_all(read(path))
        assert str(file) in str(error.value)
        with pytest.raises(InputError, match="run its stage again"):
            artifact.verify(path)
        file.write_bytes(good)
    touch_all(read(path))


@pytest.mark.xdist_group("toy")
def test_every_numeric_artifact_of_a_scene_opens_as_a_zarr_group(toy):
    kinds = {
        "features/2",
        "gaussians/2",
        "scene/5",
        "capture/2",
        "points/2",
        "channels/2",
        "agreement/2",
        "lifted/2",
    }
    kinds |= {"refined/2", "evaluation/2", "descriptors/2", "encoding/1"}
    opened = set()
    for path in toy.values():
        if (path / "zarr.json").is_file():
            group = zarr.open_group(str(path), mode="r")
            lengths = {}
            for name, axes in group.attrs["axes"].items():
                values = reduce(lambda within, part: within[part], name.split("/"), group)[:]
                assert len(axes) == values.ndim, (path, name)
                named = zip(axes, values.shape, strict=True)
                assert all(
                    n == (lengths.setdefault(a, n) if isinstance(a, str) else a) for a, n in named
                )
            opened.add(group.attrs["schema"].removeprefix("chebsplat."))
    assert opened == kinds


def test_an_artifact_of_an_older_schema_is_never_misread(case):
    _, read, path = case
    name, _, version = artifact.read_manifest(path).schema.rpartition("/")
    changed("artifact.json", lambda said: said | {"schema": f"{name}/{int(version) - 1}"})(path)
    with pytest.raises(InputError, match=r"another version of chebsplat made it: make it again"):
        read(path)


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("means", np.full((5, 3), np.nan), "non-finite"),
        ("covariances", np.full((5, 3, 3), 1e39), "non-finite"),  # in float32
        ("tracks", np.full((1, 2), 2**40), "int32 does not have"),
    ],
)
def test_values_that_an_array_cannot_hold_are_never_published(tmp_path, name, values, said):
    with pytest.raises(ValueError, match=said):
        published(tmp_path / "p", replace(make_points(), **{name: values}))
    assert not (tmp_path / "p").exists()


def test_a_capture_with_a_repeated_name_is_refused(tmp_path):
    record = make_capture()
    record.names = ["a", "b", "a"]
    with pytest.raises(InputError, match="'a' occurs 2 times"):
        record.write(tmp_path)


@pytest.mark.parametrize("degree", range(4))
def test_ply_reads_back(tmp_path, degree):
    p = gaussian_parameters()
    p["shN"][:, ply.REST[degree] :] = 0
    p["degrees"] = np.minimum(p["degrees"], degree).astype(np.uint8)
    labels = np.array([0, 5, -1, 2, 2, 1])
    ply.write_ply(tmp_path / "a.ply", p, degree, labels)
    found, file_degree, found_labels = ply.read_ply(tmp_path / "a.ply")
    assert file_degree == degree
    assert np.array_equal(found_labels, labels)
    assert set(found) == set(p)
    assert all(np.array_equal(found[name], p[name]) for name in found)


def test_an_opacity_of_exactly_0_or_1_reads(tmp_path):
    """Converters of formats with 8-bit opacities write infinite logits."""
    p = gaussian_parameters()
    p["logit_opacities"][:3] = np.inf, -np.inf, 30
    ply.write_ply(tmp_path / "a.ply", p, 3)
    found = ply.read_ply(tmp_path / "a.ply")[0]["logit_opacities"]
    assert found[:3].tolist() == [20, -20, 30]
    assert np.array_equal(found[3:], p["logit_opacities"][3:])


def test_full_ply_has_the_62_float_header(tmp_path):
    bare = {name: values for name, values in gaussian_parameters().items() if name != "degrees"}
    ply.write_ply(tmp_path / "a.ply", bare, 3)
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    rest = [f"f_rest_{i}" for i in range(45)]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert [p.name for p in vertex.properties] == names
    assert vertex.data.dtype.itemsize == 62 * 4


def test_tags_follow_the_62_floats_as_floats_and_names_are_comments(tmp_path):
    labels = np.array([0, 2, -1, 2, 2, 0])
    ply.write_ply(
        tmp_path / "a.ply", gaussian_parameters(), 3, labels, ["wall", "lamp", "round table"]
    )
    found = PlyData.read(str(tmp_path / "a.ply"))
    assert [(p.name, p.val_dtype) for p in found["vertex"].properties][-3:] == [
        ("rot_3", "f4"),
        ("sh_degree", "f4"),
        ("label", "f4"),
    ]
    assert list(found.comments) == ["label 0 wall", "label 2 round table"]


def test_features_are_within_half_a_step_of_their_row(tmp_path):
    record = make_scene()
    features = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
    features[1] *= 1e6
    features[2] = 0
    record.parameters["features"] = features
    published(tmp_path / "s", record)
    wanted = record.parameters["features"]
    found = scene.Scene.read(tmp_path / "s").parameters["features"]
    # half a step, and float32's own
    assert (np.abs(found - wanted) <= 0.51 / 127 * np.abs(wanted).max(1, keepdims=True)).all()


def test_gaussians_that_mean_the_same_share_a_row(tmp_path):
    record = make_scene()
    record.parameters["features"][3:] = record.parameters["features"][0]
    assert record.labels.tolist() == [0, 1, -1, 0, 1, 1]
    published(tmp_path / "s", record)
    stored = scene.RaggedScene.read(tmp_path / "s")
    assert stored.features.shape == (4, 4) and stored.meanings.dtype == np.uint16
    found = scene.Scene.read(tmp_path / "s")
    assert np.array_equal(found.parameters["features"], record.parameters["features"])
    assert np.array_equal(found.labels, record.labels)


def test_a_scene_that_spz_cannot_hold_says_so(tmp_path):
    record = make_scene()
    record.parameters["log_scales"] += 9
    sizes = record.write(tmp_path)
    assert "spz" not in sizes and not (tmp_path / "scene.spz").exists()
    assert "does not fit" in record.summary["left_out"]["scene.spz"]


@pytest.mark.data
def test_a_compressed_ply_is_refused_with_advice():
    with pytest.raises(InputError, match="convert it first"):
        ply.read_ply(data("gs_ply") / "guitar.compressed.ply")
