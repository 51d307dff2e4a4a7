"""The embedded teacher that ships: it runs, is as good as its figures say, and never saw what it is
measured on.
"""

import json
import tomllib
from itertools import pairwise

import numpy as np
import pytest
from shared import ROOT

from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.stages.teacher_models.image_encoder import TeacherInference
from chebsplat.synthetic import CLASS_NAMES, layout


@pytest.fixture(scope="module")
def encoder():
    return TeacherInference(read_teacher(EMBEDDED), 1)


@pytest.mark.parametrize("size", [(16, 32), (96, 64), (112, 176)])
def test_any_size_that_is_a_multiple_gives_unit_vectors_as_wide_as_the_text(encoder, size):
    image = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    found = encoder.run(image, "noise")
    assert found.shape == (384, size[0] // 2, size[1] // 2)
    assert found.dtype == np.float32
    # the map's columns are float16
    np.testing.assert_allclose(np.linalg.norm(found, axis=0), 1, atol=2e-3)


def test_the_rank_of_its_features_is_small(encoder):
    from chebsplat.teachers.network import RANK

    image = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    sizes = np.linalg.svd(
        encoder.run(image, "noise").reshape(384, -1).astype(np.float64), compute_uv=False
    )
    assert sizes[RANK] < 1e-5 * sizes[0]


def test_a_held_out_room_is_told_about_as_well_as_the_published_figures_say():
    from chebsplat.evaluation.metrics import confusion, segmentation
    from chebsplat.stages.teacher_models.text_encoder import text_embeddings
    from chebsplat.teachers.quality import held_out_room, labelled, runner

    published = json.loads((EMBEDDED.parent / "quality.json").read_text())["held_out"]
    encode, n = runner(EMBEDDED, 1), len(CLASS_NAMES)
    texts = text_embeddings(list(CLASS_NAMES), read_teacher(EMBEDDED))
    matrix = np.zeros((n, n), np.int64)
    for image, truth in held_out_room(layout.HELD_OUT[0], n_views=4):
        matrix += confusion(labelled(encode(image), texts, *truth.shape), truth, n)
    assert published["miou"] >= 0.55
    # one room of twenty, four views: 0.046 and 0.011 below
    assert segmentation(matrix).miou == pytest.approx(published["miou"], abs=0.06)
    assert segmentation(matrix).oa == pytest.approx(published["oa"], abs=0.02)


def test_no_seed_serves_two_ends():
    names = "SCENES", "REFERENCE", "HELD_OUT", "TRAINING", "KNOWLEDGE", "MODELLED"
    ranges = [getattr(layout, name) for name in names]
    assert ranges == sorted(
        (r for r in vars(layout).values() if isinstance(r, range)), key=lambda r: r.start
    )
    assert all(a.stop <= b.start for a, b in pairwise(ranges))
    for path in (ROOT / "pipelines/configs/scenes").glob("*.toml"):
        source = tomllib.loads(path.read_text())["source"]
        assert "seed" not in source or source["seed"] in layout.SCENES, path


def test_training_takes_no_other_seeds_and_its_validation_none_of_its_own():
    from chebsplat.teachers.rooms import training_views
    from chebsplat.teachers.train import ROOMS, VALIDATION

    assert not set(ROOMS) & set(VALIDATION)
    assert {*ROOMS, *VALIDATION} <= set(layout.TRAINING)
    for seed in (layout.SCENES[0], layout.HELD_OUT[0], layout.REFERENCE[0]):
        with pytest.raises(ValueError, match="not one for training"):
            training_views(seed, 1)


def test_words_that_measure_are_not_words_that_trained():
    from chebsplat.teachers.words import words

    training, unseen = words("training"), words("unseen")
    assert not {w for of in training.values() for w in of} & {
        w for of in unseen.values() for w in of
    }
    assert all(of[0] == name for name, of in training.items())
    assert len({len(of) for of in unseen.values()}) == 1
