"""The rasterizer reproduces gsplat's image; rotations and harmonics are what they are called."""

import math

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from shared import DATA

from chebsplat.rasterize import rasterize
from chebsplat.splats import sh
from chebsplat.splats.rotations import rotation_matrices


def tiny_case():
    """Arguments of `rasterize` for four Gaussians, float32, and the image [H, W, 4] that gsplat
    made of them.
    """
    file = DATA / "raster_reference/tiny_case.safetensors"
    if not file.exists():
        pytest.skip("raster_reference is missing")
    case = load_file(file)
    height, width = case["out_img"].shape[:2]
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor([0.123, 0.456, -8.0])
    focal = width / 2 / math.tan(math.radians(90) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    directions = case["means"] - torch.tensor([0.123, 0.456, -8.0])
    colors = sh.eval_sh(case["coeffs"][:, :1], case["coeffs"][:, 1:], directions, 3)
    gaussians = (
        case["means"],
        case["quats"],
        case["scales"].exp(),
        case["opacities"].sigmoid(),
        colors,
    )
    return (*gaussians, viewmat[None], K[None], width, height), case["out_img"]


@pytest.mark.data
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_reference_image_of_four_gaussians_is_matched(backend):
    arguments, expected = tiny_case()
    image, alpha, _ = rasterize(*arguments, max_alpha=0.999, backend=backend)
    error = (torch.cat([image, alpha], -1)[0] - expected).abs().max()
    assert error < 1e-4


@pytest.mark.parametrize("length", [1e-10, 1.0, 1e20])
def test_length_of_a_quaternion_does_not_matter(length):
    quats = torch.randn(6, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(rotation_matrices(quats * length), rotation_matrices(quats))


def test_harmonics_are_orthonormal():
    n = 64
    z, weights = np.polynomial.legendre.leggauss(n)
    phi = (np.arange(2 * n) + 0.5) * np.pi / n
    r = np.sqrt(1 - z**2)[:, None]
    grid = np.stack(
        [r * np.cos(phi), r * np.sin(phi), np.broadcast_to(z[:, None], (n, 2 * n))], -1
    ).reshape(-1, 3)
    values = sh.basis(torch.from_numpy(grid), 3).numpy()
    area = np.repeat(weights, 2 * n) * np.pi / n
    np.testing.assert_allclose(values.T @ (values * area[:, None]), np.eye(16), atol=1e-12)
