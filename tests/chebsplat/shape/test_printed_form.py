"""What is printed can be chosen: each setting against the printed formula, and by default nothing changes."""

import math

import numpy as np
import pytest
import torch
from shared_regions import descriptor_of

from chebsplat.settings import DescribeSection, TrainSection
from chebsplat.shape.described import n_degrees
from chebsplat.shape.fusion import Fusion, Gate
from chebsplat.shape.regions import regions_of
from chebsplat.splats.rotations import rotation_matrices

SIZES = {"n_angles": 3, "max_degree": 5, "backend": "reference", "dtype": torch.float64}


def regions(m=4, n=9, unit=1.0, seed=0):
    """means, scales [M, n, 3], rotmats [M, n, 3, 3], mask [M, n] in float64."""
    g = torch.Generator().manual_seed(seed)
    means, scales = (
        torch.rand(m, n, 3, generator=g, dtype=torch.float64),
        torch.rand(m, n, 3, generator=g, dtype=torch.float64),
    )
    rotmats = rotation_matrices(torch.randn(m * n, 4, generator=g, dtype=torch.float64)).reshape(m, n, 3, 3)
    return unit * means, unit * (0.01 + 0.5 * scales), rotmats, torch.ones(m, n, dtype=torch.bool)


def printed(means, scales, rotmats, *, beta, bandwidth, n_angles, max_degree, n_eigs=None):
    """The descriptor of one region, float64, member by member: Eqs 1-6 with M = R diag(1 / (1 + β s²)) Rᵀ, turned
    about z; the n_eigs lowest eigenpairs, or all of them with λ_max = 2 and less T_d(0), which vanishes of degree 0.
    """
    n = len(means)
    centred = means - means.mean(0)
    radius = np.sqrt((centred**2).sum(1).mean())
    out = np.zeros((n, n_angles, max_degree + 1))
    for j in range(n_angles):
        angle = 2 * math.pi * j / n_angles
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        weights = np.zeros((n, n))
        for a in range(n):
            for b in range(n):
                if a != b:
                    delta = turn.T @ (centred[a] - centred[b]) / radius
                    metrics = [rotmats[i] @ np.diag(1 / (1 + beta * scales[i] ** 2)) @ rotmats[i].T for i in (a, b)]
                    q = 0.5 * sum(delta @ metric @ delta for metric in metrics)
                    weights[a, b] = math.exp(-q / bandwidth**2)
        degree = weights.sum(1)
        laplacian = np.eye(n) - weights / np.sqrt(degree[:, None] * degree)
        values, vectors = np.linalg.eigh(laplacian)
        largest = 2 if n_eigs is None else values[n_eigs - 1]
        for d in range(max_degree + 1):
            polynomial = np.cos(d * np.arccos(np.clip(2 * values[:n_eigs] / largest - 1, -1, 1)))
            at_zero = math.cos(d * math.pi / 2) if n_eigs is None else 0
            out[:, j, d] = n * ((vectors[:, :n_eigs] ** 2) @ polynomial - at_zero)
    return out


@pytest.mark.parametrize("n_eigs", [None, 4])
def test_the_printed_metric_axis_and_spectrum_are_the_printed_formula(n_eigs):
    means, scales, rotmats, mask = regions()
    options = {"metric": "printed", "axis": "world", "from_degree": 0, "anisotropy": 10.0, "bandwidth": 0.7}
    options |= {"spectrum": "hard", "n_eigs": n_eigs} if n_eigs else {}
    found = descriptor_of(means, scales, rotmats, mask, **SIZES, **options).values
    for m in range(len(means)):
        given = (v[m].numpy() for v in (means, scales, rotmats))
        wanted = printed(*given, beta=10.0, bandwidth=0.7, n_angles=3, max_degree=5, n_eigs=n_eigs)
        assert np.abs(found[m].numpy() - wanted).max() < 1e-12
    if n_eigs is None:
        assert (found[..., :2].abs() < 1e-12).all()  # degrees 0 and 1 are identically constant


def test_the_printed_metric_has_a_finite_gradient_that_finite_differences_confirm():
    *given, mask = regions(1, 5)

    def described(*given):
        return descriptor_of(*given, mask, **SIZES, metric="printed", axis="world").values

    leaves = [value.requires_grad_(True) for value in given]
    assert torch.autograd.gradcheck(described, leaves, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("spectrum", ["full", "hard"])
def test_the_first_degree_is_chosen_and_what_is_added_vanishes(spectrum):
    given = regions()
    options = SIZES | {"spectrum": spectrum, "n_eigs": 4}
    every, rest = (descriptor_of(*given, **options, from_degree=first).values for first in (0, 2))
    assert torch.equal(every[..., 2:], rest)
    assert every.shape[-1] == n_degrees(spectrum, 5, 0) == 6
    assert (every[..., :2] == 0).all() == (spectrum == "full")
    default = descriptor_of(*given, **options).values
    assert torch.equal(default, rest if spectrum == "full" else every)
    compiled = descriptor_of(*(v.float() for v in given[:3]), given[3], n_angles=3, max_degree=5, from_degree=0)
    assert compiled.values.shape[-1] == 6
    assert (compiled.values[..., :2] == 0).all()


def test_a_spectrum_of_zeros_is_guarded_and_counted():
    far = torch.tensor([[[1e3 * k, 0.0, 0.0] for k in (0, 1e-3, 1, 1.001, 2, 2.001)]], dtype=torch.float64)
    scales, rotmats = torch.full_like(far, 1e-3), torch.eye(3, dtype=torch.float64).expand(1, 6, 3, 3)
    options = SIZES | {"spectrum": "hard", "n_eigs": 2, "bandwidth": 1e-3}
    found = descriptor_of(far, scales, rotmats, torch.ones(1, 6, dtype=torch.bool), **options)
    assert found.values.isfinite().all()
    assert found.n_guarded == SIZES["n_angles"]
    assert descriptor_of(*regions(), **(SIZES | {"spectrum": "hard", "n_eigs": 4})).n_guarded == 0


def test_regions_of_a_given_radius_and_overlap_and_without_thinning():
    points = np.random.default_rng(0).random((3000, 3))
    ours = regions_of(points, DescribeSection(n_regions=40, region_size=16))
    tight = regions_of(points, DescribeSection(n_regions=40, region_size=16, overlap=1.0))
    assert tight.radius == pytest.approx(ours.radius / 1.5)
    fixed = regions_of(points, DescribeSection(n_regions=40, region_size=16, region_radius=0.07))
    assert fixed.radius == 0.07
    assert np.array_equal(
        regions_of(points, DescribeSection(n_regions=40, region_size=16, region_radius=0.07), earlier=fixed).members,
        fixed.members,
    )
    nearest = regions_of(points, DescribeSection(n_regions=40, region_size=16, thinning=False))
    assert nearest.share == 1.0
    for center, members in zip(nearest.centers, nearest.members, strict=True):
        wanted = np.argsort(np.linalg.norm(points - points[center], axis=1))[:16]
        assert set(members) == set(wanted)
    held = regions_of(points, DescribeSection(n_regions=40, region_size=16, overlap=1.0), earlier=tight)
    assert np.array_equal(held.centers, tight.centers)
    assert held.radius == tight.radius


def test_the_exported_fusion_has_the_trained_inflation_and_temperature(tmp_path):
    import onnx

    from chebsplat.stages.onnx import compare, fusion_example
    from chebsplat.stages.shape_models.region_graph import fusion_model

    torch.manual_seed(0)
    differences = []
    for inflation, temperature in ((0.25, 1.0), (0.0, 1.0), (0.1, 7.0)):
        fusion = Fusion(Gate(4, 0.0), inflation, temperature).eval()
        onnx.save(fusion_model(fusion), tmp_path / "a.onnx")
        given = fusion_example(4, 16, 64)
        assert compare(fusion, tmp_path / "a.onnx", given) < 1e-5
        differences.append(compare(Fusion(Gate(4, 0.0)), tmp_path / "a.onnx", given))
    assert differences[0] < 1e-5 < min(differences[1:])


def test_the_gate_starts_where_the_setting_says():
    features, shape, covered = torch.ones(2, 3), torch.zeros(2, 3), torch.tensor([True, False])
    fused, gate = Gate(3, TrainSection(gate_start=0.0).gate_start)(features, shape, covered)
    assert torch.allclose(fused[0], torch.full((3,), 0.5))
    assert (gate[1] == 1).all()
