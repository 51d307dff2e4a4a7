"""The map of a teacher's channels: exact, streamed, independent of order, and it keeps what words
are told apart by.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shared import published

from chebsplat.formats.channels import ChannelMap
from chebsplat.labels.channels import ROWS, Moments, channel_map


def unit(values):
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def low_rank(rank, n_channels, n=400, seed=0):
    """Features [n, C] of a rank whose directions fall in size by ten."""
    rng = np.random.default_rng(seed)
    scale = np.logspace(0, -1, rank)
    return (rng.normal(size=(n, rank)) * scale) @ rng.normal(size=(rank, n_channels))


def words(n_channels, n=40, seed=1):
    return unit(np.random.default_rng(seed).normal(size=(n, n_channels)))


def moments(*parts):
    found = Moments(parts[0].shape[-1])
    for part in parts:
        found.add(part)
    return found


@settings(max_examples=20, deadline=None)
@given(rank=st.integers(1, 8), extra=st.integers(0, 5), seed=st.integers(0, 99))
def test_features_of_a_rank_come_through_as_many_channels_exactly(rank, extra, seed):
    features, vocabulary = low_rank(rank, 12, seed=seed), words(12, seed=seed)
    matrix, energy = channel_map(moments(features), vocabulary, rank + extra)
    assert matrix.shape == (12, rank)  # no more than there are
    assert np.allclose(energy[rank - 1 :], 1, atol=1e-12)
    restored = features @ matrix @ matrix.T
    assert np.linalg.norm(restored - features) < 1e-6 * np.linalg.norm(features)
    assert np.allclose(
        (features @ matrix) @ (vocabulary @ matrix).T, features @ vocabulary.T, atol=1e-6
    )


@pytest.mark.parametrize("n_channels", [1, 5, 24])
def test_the_transpose_is_the_inverse(n_channels):
    matrix, energy = channel_map(moments(low_rank(24, 24)), words(24), n_channels)
    assert np.allclose(matrix.T @ matrix, np.eye(n_channels), atol=1e-12)
    assert np.all(np.diff(energy) >= -1e-15)
    assert energy[-1] == pytest.approx(1)


def test_energy_is_the_share_that_the_kept_channels_hold():
    features = low_rank(24, 24)
    matrix, energy = channel_map(moments(features), words(24), 7)
    share = np.linalg.norm(features @ matrix) ** 2 / np.linalg.norm(features) ** 2
    assert energy[6] == pytest.approx(share, abs=1e-9)


def test_without_a_vocabulary_no_other_channels_hold_more():
    features = low_rank(24, 24)
    _, energy = channel_map(moments(features), np.zeros((0, 24)), 7)
    best = np.cumsum(np.linalg.svd(features, compute_uv=False) ** 2) / np.linalg.norm(features) ** 2
    assert np.allclose(energy, best, atol=1e-12)


def test_streaming_equals_batch_in_any_order():
    features = low_rank(20, 24, n=3000)
    batch = channel_map(moments(features), words(24), 9)
    parts = np.array_split(features, 7)
    np.random.default_rng(0).shuffle(parts := [p.reshape(-1, 1, 24) for p in parts])
    streamed = channel_map(moments(*parts), words(24), 9)
    assert np.allclose(batch[0], streamed[0], atol=1e-9)
    assert np.allclose(batch[1], streamed[1], atol=1e-12)


def test_a_large_view_is_summed_in_float64():
    values = np.full((ROWS + 5, 2), 0.1, np.float32)
    found = moments(values)
    assert found.count == ROWS + 5
    assert found.products[0, 1] == pytest.approx(
        (ROWS + 5) * float(np.float32(0.1)) ** 2, rel=1e-12
    )


def test_the_vocabulary_saves_label_decisions():
    """Words differ in directions that hold little of the energy, as a text encoder's do."""
    rng = np.random.default_rng(3)
    common, telling = np.zeros(40), np.diag(np.r_[np.zeros(20), np.full(20, 0.3)])
    common[0] = 1
    vocabulary = unit(common + rng.normal(size=(60, 40)) @ telling)
    nuisance = np.r_[0, np.full(19, 0.6), np.zeros(20)]
    features = unit(vocabulary[rng.integers(0, 60, 4000)] + rng.normal(size=(4000, 40)) * nuisance)
    wanted = (features @ vocabulary.T).argmax(1)

    def agreement(weight):
        matrix, _ = channel_map(moments(features), vocabulary, 20, weight)
        return ((features @ matrix) @ (vocabulary @ matrix).T).argmax(1) == wanted

    assert agreement(0.0).mean() < 0.5
    assert agreement(1.0).mean() > 0.95


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.full((3, 4), np.nan), "12 non-finite"),
        (np.ones((3, 5)), "5 channels, expected 4"),
        (np.zeros((3, 4)), "no energy"),
    ],
)
def test_features_that_give_no_channels_are_refused(bad, message):
    def make():
        found = Moments(4)
        found.add(bad)
        channel_map(found, words(4), 2)

    with pytest.raises(ValueError, match=message):
        make()


def test_a_channel_map_reads_back_and_restores(tmp_path):
    exact = channel_map(moments(low_rank(8, 12)), words(12), 5)
    matrix, energy = (part.astype(np.float32) for part in exact)
    record = ChannelMap(matrix, matrix.T.copy(), energy, "lseg", {"n_pixels": 400})
    found = ChannelMap.read(published(tmp_path / "p", record))
    assert (found.teacher, found.notes) == ("lseg", {"n_pixels": 400})
    assert all(
        np.array_equal(getattr(found, k), getattr(record, k))
        for k in ("matrix", "inverse", "energy")
    )
    features = low_rank(8, 12).reshape(20, 20, 12)
    once = found.restore(found.apply(features))
    assert np.allclose(found.restore(found.apply(once)), once, atol=1e-4)
    assert found.embed(words(12)).shape == (40, 5)
