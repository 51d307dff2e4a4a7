"""Gaussians that break rasterizers: images, gradients, colours, planes, features of a default run.

Errors are those of float32 on the CPU against float64 in plain torch or numpy. Of images and
features it is the mean difference over the mean, of gradients that of norms: where float32 rounds
an alpha across 1/255, one pixel differs.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from benchmarks.stability.case import Outcome, case, relative
from chebsplat.rasterize import lift, rasterize, reference
from chebsplat.render import SceneRenderer
from chebsplat.splats.gaussians import initial_gaussians, local_shape, surface_of
from chebsplat.splats.planes import planes_in_view
from chebsplat.splats.sh import basis, colors_in_view
from chebsplat.training.densify import shared_opacity, shared_scales
from chebsplat.training.losses import photometric, photometric_reference
from chebsplat.views import View, in_frustum

N, WIDTH, HEIGHT = 60, 40, 28
K = torch.tensor([[35.0, 0, WIDTH / 2], [0, 33.0, HEIGHT / 2], [0, 0, 1]])
IMAGE = 1e-4  # one pixel of a thousand that gains or loses 1/255 is 1e-5 of its mean
SLOPE = 1e-2  # of a gradient, in which such a pixel counts more


def gaussians() -> dict[str, Tensor]:
    """Means before a camera at the origin, wxyz quaternions, deviations, opacities and colours."""
    g = torch.Generator().manual_seed(0)
    return {
        "means": torch.rand(N, 3, generator=g) * torch.tensor([2.4, 1.6, 3.0])
        - torch.tensor([1.2, 0.8, -1.0]),
        "quats": torch.randn(N, 4, generator=g),
        "scales": torch.rand(N, 3, generator=g) * 0.15 + 0.02,
        "opacities": torch.rand(N, generator=g) * 0.8 + 0.1,
        "colors": torch.rand(N, 3, generator=g),
    }


def flat(ratio: float) -> Callable[[dict[str, Tensor]], object]:
    return lambda g: g["scales"][::2, 2].mul_(ratio)


def needle(length: float, width: float) -> Callable[[dict[str, Tensor]], object]:
    return lambda g: g["scales"][::2].copy_(torch.tensor([length, width, width]))


def times(name: str, factor: float) -> Callable[[dict[str, Tensor]], object]:
    return lambda g: g[name][::2].mul_(factor)


def at(z: float) -> Callable[[dict[str, Tensor]], object]:
    return lambda g: g["means"][::2, 2].fill_(z)


SPOILED: dict[str, Callable[[dict[str, Tensor]], object]] = {
    **{f"near-flat {ratio:.0e}": flat(ratio) for ratio in (1e-2, 1e-4, 1e-8, 0.0)},
    **{f"needles {length:.0e} by {width:.0e}": needle(length, width)
       for length, width in ((1.0, 1e-3), (1.0, 1e-6), (1e2, 1e-3), (1e3, 1e-9), (1e-3, 1e-9))},
    **{f"quaternions times {factor:.0e}": times("quats", factor)
       for factor in (1e-30, 1e-10, 1e10, 1e30)},
    **{f"scales times {factor:.0e}": times("scales", factor) for factor in (1e-6, 1e-3, 1e2, 1e6)},
    **{f"colours times {factor:.0e}": times("colors", factor) for factor in (1e-4, 1e4)},
    **{f"at a depth of {z:g}": at(z) for z in (0.0101, 1e4)},
    "all in one place": lambda g: g["means"].copy_(torch.tensor([0.1, 0.1, 2.0]).expand(N, 3)),
}  # fmt: skip


def rendered(name: str, dtype: torch.dtype, mode: str) -> tuple[Tensor, list[Tensor]]:
    """Image and coverage [1, H, W, 4], and a loss' gradients to all parameters of the Gaussians."""
    spoiled = gaussians()
    SPOILED[name](spoiled)
    leaves = [value.to(dtype, copy=True).requires_grad_(True) for value in spoiled.values()]
    camera = torch.eye(4, dtype=dtype)[None], K.to(dtype)[None], WIDTH, HEIGHT
    # float64 takes the reference
    image, alpha, _ = rasterize(*leaves, *camera, rasterize_mode=mode)
    weights = torch.randn(HEIGHT, WIDTH, 4, generator=torch.Generator().manual_seed(1)).to(dtype)
    both = torch.cat([image, alpha], -1)
    return both.detach(), list(torch.autograd.grad((both[0] * weights).mean(), leaves))


def apart(ours: Tensor, exact: Tensor) -> float:
    """Mean difference over the mean; inf where one is not finite."""
    if not (ours.isfinite().all() and exact.isfinite().all()):
        return math.inf
    return float((ours.double() - exact).abs().mean() / exact.abs().mean().clamp_min(1e-12))


@case("image, {mode}, {name}", mode=["classic", "antialiased"], name=SPOILED)
def image(mode: str, name: str) -> Outcome:
    return Outcome(
        apart(rendered(name, torch.float32, mode)[0], rendered(name, torch.float64, mode)[0]), IMAGE
    )


@case("gradient, {mode}, {name}", mode=["classic", "antialiased"], name=SPOILED)
def gradient(mode: str, name: str) -> Outcome:
    """Raises ValueError where one is not finite."""
    pairs = zip(
        rendered(name, torch.float32, mode)[1], rendered(name, torch.float64, mode)[1], strict=True
    )
    errors = []
    for ours, exact in pairs:
        if not ours.isfinite().all():
            raise ValueError("a gradient is not finite")
        errors.append(float((ours.double() - exact).norm() / exact.norm().clamp_min(1e-12)))
    return Outcome(max(errors), SLOPE)


@case("planes, {name}", name=SPOILED)
def planes(name: str) -> Outcome:
    """Inverse depths of planes, and their gradients, against float64; relative to the largest."""
    spoiled, both = gaussians(), []
    SPOILED[name](spoiled)
    for dtype in (torch.float32, torch.float64):
        leaves = [
            spoiled[key].to(dtype, copy=True).requires_grad_(True) for key in ("means", "quats")
        ]
        inverse = planes_in_view(
            *leaves, spoiled["scales"].to(dtype), torch.eye(4, dtype=dtype), K.to(dtype), 0.01
        )
        slopes = torch.autograd.grad(inverse.sum(), leaves)
        lengths = spoiled["quats"].to(dtype).abs().amax(1, keepdim=True)
        both.append([inverse.detach(), slopes[0], slopes[1] * lengths])
    return Outcome(max(relative(*pair) for pair in zip(*both, strict=True)), 1e-3)


@case("features, {name}", name=SPOILED)
def features(name: str) -> Outcome:
    """Features of cells lifted to Gaussians, against every Gaussian at every pixel."""
    spoiled = gaussians()
    SPOILED[name](spoiled)
    parts = tuple(spoiled[key].numpy() for key in ("means", "quats", "scales", "opacities"))
    values = np.random.default_rng(0).normal(size=(HEIGHT // 4, WIDTH // 4, 5)).astype(np.float32)
    rest = (
        np.eye(4),
        K.double().numpy(),
        (WIDTH, HEIGHT),
        values,
        np.ones(values.shape[:2], np.float32),
    )
    lifted, (weights, sums) = lift.lift(parts, *rest), reference.lift(parts, *rest)
    dense = np.zeros((N, 6))
    dense[lifted.ids] = np.column_stack([lifted.weights, lifted.sums])
    exact = torch.from_numpy(np.column_stack([weights, sums]))
    return Outcome(apart(torch.from_numpy(dense), exact), IMAGE)


@case("a finished scene, {name}", name=SPOILED)
def finished(name: str) -> Outcome:
    """Share of values of its frame, depth, coverage, normals and frustum that cannot be."""
    spoiled = gaussians()
    SPOILED[name](spoiled)
    raw = {
        "means": spoiled["means"],
        "quats": spoiled["quats"],
        "log_scales": spoiled["scales"].log().clamp_min(-60),
    }
    raw |= {
        "logit_opacities": spoiled["opacities"].logit(),
        "sh0": (spoiled["colors"][:, None] - 0.5) / 0.282,
    }
    raw |= {"shN": torch.zeros(N, 15, 3), "degrees": torch.zeros(N, dtype=torch.uint8)}
    parameters = {key: value.numpy() for key, value in raw.items()}
    view, renderer = View(K, torch.eye(4), WIDTH, HEIGHT), SceneRenderer(parameters)
    frame, _ = renderer.render(view)
    depth, covered = renderer.render_depth(view)
    normals = surface_of(parameters)[0]
    index = in_frustum(renderer.means, view, renderer.reach)
    wrong = [
        ~np.isnan(depth) & ~(depth > 0),
        ~((covered >= 0) & (covered <= 1.0001)),
        ~np.isfinite(normals),
    ]
    if frame.shape != (HEIGHT, WIDTH, 3) or not 0 < len(index) <= N:
        raise ValueError("there is no frame")
    return Outcome(float(np.mean([part.mean() for part in wrong])), 0.0)


@case("1e6 on a pixel, opacity {opacity}", opacity=[0.002, 0.0041, 0.05, 0.5, 0.7])
def on_a_pixel(opacity: float) -> Outcome:
    """Equal Gaussians, one behind another, against the series until a transmittance of 1e-4."""
    n, size = 1_000_000, 8
    camera = (
        torch.eye(4)[None],
        torch.tensor([[[40.0, 0, size / 2], [0, 40.0, size / 2], [0, 0, 1]]]),
        size,
        size,
    )
    means = torch.tensor([[0.5 / 40, 0.5 / 40, 1.0]]).repeat(n, 1)  # the middle of pixel (4, 4)
    shape = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), 1e-4)
    opacities = torch.full((n,), opacity).requires_grad_(True)
    colors = torch.tensor([[0.25, 0.5, 1.0]]).repeat(n, 1).requires_grad_(True)
    render, alpha, _ = rasterize(means, *shape, opacities, colors, *camera)
    left, n_visible = 1.0, 0
    while opacity >= 1 / 255 and left * (1 - opacity) > 1e-4:
        left, n_visible = left * (1 - opacity), n_visible + 1
    to_opacities, to_colors = torch.autograd.grad(
        render[0, 4, 4].sum() + alpha[0, 4, 4].sum(), [opacities, colors]
    )
    if not (to_opacities.isfinite().all() and int((to_colors[:, 0] != 0).sum()) == n_visible):
        raise ValueError("a gradient is not finite, or reaches Gaussians that nobody sees")
    values = [*render[0, 4, 4].tolist(), alpha[0, 4, 4, 0].item(), to_colors[:, 0].sum().item()]
    return Outcome(relative(values, (1 - left) * np.array([0.25, 0.5, 1.0, 1.0, 1.0])), 1e-4)


@case("SH of {size:.0e}, degree {degree}", size=[1e-4, 1e4, 1e30], degree=[0, 1, 2, 3])
def sh(size: float, degree: int) -> Outcome:
    """Colours and gradients of the fused kernel against float64, where they are not cut off."""
    g, index = torch.Generator().manual_seed(0), torch.arange(0, N, 2)
    bands = [size * torch.randn(N, 2 * band + 1, 3, generator=g) for band in range(4)]
    means, both = torch.randn(N, 3, generator=g), []
    for dtype in (torch.float32, torch.float64):
        leaves = [band.to(dtype, copy=True).requires_grad_(True) for band in bands[: degree + 1]]
        colors = colors_in_view(
            leaves, None, index, means.to(dtype), torch.zeros(3, dtype=dtype), degree
        )
        slopes = torch.autograd.grad(colors.sum(), leaves)
        both.append([colors.detach(), *slopes])
    values = basis(torch.nn.functional.normalize(means[index].double(), dim=-1), degree)
    coefficients = torch.cat([band[index].double() for band in bands[: degree + 1]], 1)
    exact = (torch.einsum("nk,nkc->nc", values, coefficients) + 0.5).clamp_min(0)
    return Outcome(
        max(relative(both[0][0], exact), *(relative(*pair) for pair in zip(*both, strict=True))),
        1e-5,
    )


@case("colour loss of renders of {size:.0e}", size=[0.0, 1.0, 1e2, 1e4, 1e8])
def loss(size: float) -> Outcome:
    """The fused loss and its gradient against float64 in plain torch."""
    g = torch.Generator().manual_seed(0)
    target, drawn, both = (
        torch.rand(HEIGHT, WIDTH, 3, generator=g),
        torch.rand(HEIGHT, WIDTH, 3, generator=g),
        [],
    )
    for dtype, function in ((torch.float32, photometric), (torch.float64, photometric_reference)):
        render = (size * drawn).to(dtype).requires_grad_(True)
        value = function(render, target.to(dtype), None, 0.2)
        both.append([value.detach(), torch.autograd.grad(value, render)[0]])
    return Outcome(max(relative(*pair) for pair in zip(*both, strict=True)), 1e-3)


POINTS: dict[str, Callable[[Tensor], Tensor]] = {
    "a plane": lambda p: p * torch.tensor([1.0, 1, 0]),
    "a near-flat sheet": lambda p: p * torch.tensor([1.0, 1, 1e-9]),
    "a line": lambda p: p * torch.tensor([1.0, 0, 0]),
    "one place": lambda p: p * 0 + 1,
    "pairs": lambda p: p[::2].repeat(2, 1),
    "units of 1e-4": lambda p: 1e-4 * p,
    "units of 1e+04": lambda p: 1e4 * p,
    "1e+06 from the origin": lambda p: p.double() + 1e6,
}


@case("Gaussians at points of {name}", name=POINTS)
def points(name: str) -> Outcome:
    """Share of initial values that are not finite; ValueError if a covariance is not positive."""
    means = (
        POINTS[name](torch.randn(200, 3, generator=torch.Generator().manual_seed(0)))
        .double()
        .numpy()
    )
    shapes, normals = local_shape(means, 16)
    if np.linalg.eigvalsh(shapes.astype(np.float64)).min() <= 0:
        raise ValueError("a covariance is not positive")
    raw = initial_gaussians(means, np.full((len(means), 3), 128, np.uint8), shapes)
    values = np.concatenate([normals.ravel(), *(value.numpy().ravel() for value in raw.values())])
    return Outcome(float(1 - np.isfinite(values).mean()), 0.0)


@case("halves, {name}", name=SPOILED)
def halves(name: str) -> Outcome:
    """Share of opacities and scales of split Gaussians that are not finite, or that grew."""
    spoiled = gaussians()
    SPOILED[name](spoiled)
    logits, log_scales = spoiled["opacities"].logit(), spoiled["scales"].log().clamp_min(-60)
    offsets = spoiled["scales"] * torch.randn(N, 3, generator=torch.Generator().manual_seed(2))
    opacity = shared_opacity(logits, log_scales, spoiled["quats"], offsets)
    smaller = shared_scales(log_scales, spoiled["quats"], offsets)
    wrong = [
        ~(opacity <= logits + 1e-4),
        ~opacity.isfinite(),
        ~(smaller <= log_scales),
        ~smaller.isfinite(),
    ]
    return Outcome(float(torch.cat([part.float().flatten() for part in wrong]).mean()), 0.0)
