"""The point encoder sees shape alone: whichever way a room stands, in whatever unit, and however
dense its points.
"""

import numpy as np
import pytest
import torch

from chebsplat.cameras import common_up, upright
from chebsplat.settings import DescribeSection
from chebsplat.shape import point_encoder
from chebsplat.shape.lessons import solved, summed
from chebsplat.shape.point_encoder import N_HEADS, PointEncoder, Standardize, cloud_of
from chebsplat.shape.point_inputs import RADII, REACH, point_inputs, truncation
from chebsplat.splats.gaussians import local_shape
from chebsplat.synthetic.rays import look_at, walk

UP = np.array([0.0, 0.0, 1.0])


def corner(n=900, seed=0):
    """Points, normals and covariances of a floor and a wall of 2 m, with a box on the floor."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0, 2, (2, n))
    floor, wall = np.stack([a, b, 0 * a], 1)[: n // 2], np.stack([0 * a, a, b], 1)[n // 2 :]
    box = np.array([0.8, 0.8, 0]) + rng.uniform(0, 0.4, (n // 4, 3))
    box[np.arange(len(box)), rng.integers(0, 3, len(box))] = 0.4
    means = np.concatenate([floor, wall, box]) + rng.normal(0, 1e-4, (n + n // 4, 3))
    covariances, normals = local_shape(means, 16)
    normals[np.einsum("ni,ni->n", normals, np.array([1.5, 1.5, 1.5]) - means) < 0] *= -1
    return means, normals, covariances


def turn(seed=3):
    R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return R * np.linalg.det(R)


@pytest.fixture(scope="module")
def seen():
    return point_inputs(*corner(), up=UP)


@pytest.fixture(scope="module")
def encoder(seen):
    torch.manual_seed(0)
    made = PointEncoder(5, seen.descriptors.shape[1])
    made.set_inputs([cloud_of(seen)], sample=1)
    return made.eval()


def test_a_shorter_series_tells_shapes_apart_less_as_a_longer_one_does():
    means, _, covariances = corner()
    lost = [
        truncation(means, covariances, up=UP, describe=DescribeSection(max_degree=d))
        for d in (2, 8)
    ]
    assert 0 <= lost[1] < lost[0] < 1
    turned = truncation(10 * means + 5, 100 * covariances, up=UP, unit=10.0)
    assert turned == pytest.approx(lost[1], abs=1e-3)  # of a scene in decimetres
    assert truncation(means[:2], covariances[:2], up=UP) is None
    # no point has another near it: nothing to tell apart
    line = np.arange(40.0)[:, None] * [[100, 0, 0]]
    assert truncation(line, np.tile(np.eye(3), (40, 1, 1)), up=UP) is None


def test_a_room_that_stands_otherwise_in_another_unit_is_the_same_room(seen):
    means, normals, covariances = corner()
    R = turn()
    scale = 7.0
    other = point_inputs(
        scale * means @ R.T + 100,
        (normals @ R.T).astype(np.float32),
        scale**2 * np.einsum("ij,njk,lk->nil", R, covariances, R).astype(np.float32),
        up=R @ UP,
        unit=scale,
    )
    np.testing.assert_allclose(other.own, seen.own, atol=2e-4)

    def across(inputs):
        return np.linalg.norm(inputs.means[:, None, :2] - inputs.means[None, :50, :2], axis=-1)

    np.testing.assert_allclose(across(other), across(seen), atol=1e-4)


def test_neighbours_lie_within_reach_and_far_ones_are_seen_at_large_radii(seen):
    for index, radius in enumerate(RADII):
        rows = seen.neighbors[:, index]
        distance = np.linalg.norm(seen.means[rows] - seen.means[:, None], axis=-1)
        assert distance[rows >= 0].max() <= REACH * radius * (1 + 1e-5)
    rows = seen.neighbors[:, 2]
    far = np.linalg.norm(seen.means[rows] - seen.means[:, None], axis=-1) * (rows >= 0)
    # 24 neighbours reach as far as the radius, not as the spacing
    assert np.median(far.max(1)) > 0.5 * RADII[2]


def attended(scale, tokens):
    """Textbook attention of the learned token to itself and to neighbours' tokens [K, h], in NumPy:
    [2 h].
    """
    w = {name: value.detach().double().numpy() for name, value in scale.state_dict().items()}

    def normal(rows, name):
        less = rows - rows.mean(-1, keepdims=True)
        return (
            less / np.sqrt((less**2).mean(-1, keepdims=True) + 1e-5) * w[f"{name}.weight"]
            + w[f"{name}.bias"]
        )

    def fed(rows):
        hidden = normal(rows, "norm_after") @ w["feed.0.weight"].T + w["feed.0.bias"]
        return rows + (hidden / (1 + np.exp(-hidden))) @ w["feed.2.weight"].T + w["feed.2.bias"]

    rows = normal(np.vstack([w["token"], tokens]), "norm")
    q, k, v = (
        (rows @ w[f"{name}.weight"].T).reshape(len(rows), N_HEADS, -1)
        for name in ("query", "key", "value")
    )
    scores = np.exp(np.einsum("hd,khd->kh", q[0], k) / np.sqrt(q.shape[2]))
    heads = np.einsum("kh,khd->hd", scores / scores.sum(0), v).ravel()
    mean = fed(tokens).mean(0) if len(tokens) else np.zeros(len(w["token"]))
    return np.concatenate([fed(w["token"] + heads @ w["out.weight"].T), mean])


def test_features_are_the_written_formula(seen, encoder):
    """In float64, neighbour by neighbour; of a point whose neighbours are whole, masked in the
    midst, or none.
    """
    point, double = 17, PointEncoder(**encoder.settings).double()
    double.load_state_dict(encoder.state_dict())
    cloud = point_encoder.Cloud(
        *(v.double() if v.is_floating_point() else v for v in cloud_of(seen))
    )
    embedded = double.embedded(cloud.own, cloud.descriptors)
    for missing in ([], [0, 3, 4], range(seen.neighbors.shape[2])):
        neighbors = cloud.neighbors[[point]].clone()
        neighbors[:, :, list(missing)] = -1
        parts = [embedded[point].detach()]
        for index, (radius, scale) in enumerate(zip(RADII, double.scales, strict=True)):
            tokens = []
            for j in neighbors[0, index][neighbors[0, index] >= 0]:
                o = (cloud.means[j] - cloud.means[point]) / radius
                n, m = cloud.normals[point], cloud.normals[j]
                along = o @ n
                lengths = [
                    o.norm(),
                    o[:2].norm(),
                    o[2].abs(),
                    along,
                    (o - along * n).norm(),
                    n @ m,
                    m[2] - n[2],
                ]
                between = torch.cat([o, torch.stack(lengths)])
                token = (
                    scale.point(embedded[point])
                    + scale.neighbor(embedded[j])
                    + scale.place(between)
                )
                tokens.append(token.detach().numpy())
            stacked = np.array(tokens).reshape(len(tokens), encoder.settings["hidden"])
            parts.append(torch.from_numpy(attended(scale, stacked)))
        whole = torch.cat(parts)
        wanted = torch.cat([whole, double.decode(whole).detach(), torch.ones(1)])
        found = double(cloud, embedded, torch.tensor([point]), neighbors)[0].detach()
        torch.testing.assert_close(found, wanted.double(), rtol=1e-12, atol=1e-12)
        if not missing:
            np.testing.assert_allclose(encoder.encode(seen)[point], wanted.numpy(), atol=2e-5)


def test_a_point_without_neighbours_and_coincident_points_have_finite_answers(encoder):
    for means in (np.zeros((1, 3)), np.zeros((40, 3)), np.array([[0.0, 0, 0], [1e4, 0, 0]])):
        n = len(means)
        inputs = point_inputs(
            means, np.tile(UP, (n, 1)), np.tile(1e-4 * np.eye(3), (n, 1, 1)), up=UP
        )
        features = encoder.encode(inputs)
        assert features.shape == (n, encoder.n_features)
        assert np.isfinite(features).all()
    with pytest.raises(ValueError, match="finite"):
        point_inputs(np.array([[np.nan, 0, 0]]), np.array([UP]), np.eye(3)[None], up=UP)


def test_it_learns_what_shape_tells(seen):
    """Floor, wall and box top have a vector each; taught on one room, the encoder knows them in
    another.
    """
    codes = np.eye(5, dtype=np.float32)[:3]

    def example(seed):
        means, normals, covariances = corner(seed=seed)
        labels = np.where(np.abs(normals[:, 2]) < 0.5, 0, np.where(means[:, 2] > 0.2, 1, 2))
        inputs = point_inputs(means, normals, covariances, up=UP)
        features, n_views = torch.from_numpy(codes[labels]), np.full(len(means), 3)
        return point_encoder.Example(cloud_of(inputs), features, n_views, labels), inputs

    (first, seen), (second, inputs) = example(1), example(2)
    torch.manual_seed(0)
    encoder = PointEncoder(5, first.cloud.descriptors.shape[1])
    encoder.set_inputs([first.cloud], sample=1)
    losses = list(
        point_encoder.train_encoder(encoder, [first], point_encoder.Course(steps=60, batch=128))
    )
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:3])
    of_room = summed(encoder.eval().encode(seen), codes[first.labels], np.ones(len(first.labels)))
    for answers in (
        encoder.answers(torch.from_numpy(encoder.encode(inputs))).detach().numpy(),  # of the course
        encoder.encode(inputs) @ solved(of_room, 1e-2),  # of a lesson
    ):
        assert (answers.argmax(1) == second.labels).mean() > 0.9


def test_up_is_where_the_cameras_tops_point():
    poses = walk((5.0, 4.0, 2.7), 40, 0)
    up, sure = common_up(poses)
    np.testing.assert_allclose(up, UP, atol=1e-6)
    assert sure > 0.9
    R = turn(5)
    moved = poses.copy()
    moved[:, :3, :3] = poses[:, :3, :3] @ R.T
    np.testing.assert_allclose(common_up(moved)[0], R @ UP, atol=1e-6)


def test_cameras_that_cannot_tell_up_say_so():
    same = np.tile(look_at(np.array([0, 0, 1.0]), np.array([3, 0, 0.0])), (5, 1, 1))
    assert common_up(same)[1] == 0
    from scipy.spatial.transform import Rotation

    rolled = np.tile(np.eye(4), (200, 1, 1))
    rolled[:, :3, :3] = Rotation.random(200, rng=0).as_matrix()
    assert common_up(rolled)[1] < 0.3


def test_upright_is_a_rotation_whatever_up_is():
    for up in (UP, -UP, np.array([1.0, 2, 3]), np.array([1e-9, 0, 0])):
        R = upright(up)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
        np.testing.assert_allclose(R @ up, [0, 0, np.linalg.norm(up)], atol=1e-12)
    with pytest.raises(ValueError, match="no length"):
        upright(np.zeros(3))


def test_inputs_are_standardised_and_outliers_bounded():
    norm = Standardize(3)
    norm.set(torch.tensor([100.0, -2.0, 0.0]), torch.tensor([0.5, 0.0, 1.0]))
    found = norm(torch.tensor([[101.0, -2.0, 0.25], [1e30, -2.0, -9.0]]))
    assert found.tolist() == [[2.0, 0.0, 0.25], [5.0, 0.0, -5.0]]
