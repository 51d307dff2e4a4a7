"""Splats of other programs' formats hold what their specifications say, in the axes of a PLY
file.
"""

import gzip
import logging
import struct

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from scipy.special import expit, logit
from shared import gaussian_parameters

import chebsplat.kernels.jit  # noqa: F401  # chooses the threading layer before gsply's numba
from chebsplat.errors import InputError
from chebsplat.formats import ply
from chebsplat.formats.splats import READ, is_splat, read_splats
from chebsplat.splats.sh import basis

N = 40


def given(degree=3):
    p = gaussian_parameters(N)
    p["shN"] = np.random.default_rng(1).uniform(-0.9, 0.9, p["shN"].shape).astype(np.float32)
    p["shN"][:, ply.REST[degree] :] = 0
    p["quats"] /= np.linalg.norm(p["quats"], axis=1, keepdims=True)
    del p["degrees"]
    return p


def changed(path, p, rename=(), more=None):
    """A PLY of parameters without some properties, with others."""
    ply.write_ply(path, p, 3)
    data = PlyData.read(str(path))["vertex"].data
    names = [name for name in data.dtype.names if name not in rename]
    extra = more or {}
    rows = np.empty(len(data), [(name, "<f4") for name in [*names, *extra]])
    for name in names:
        rows[name] = data[name]
    for name, values in extra.items():
        rows[name] = values
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
    return path


def alike(found, wanted, axes=1e-3):
    """Two quaternions of either sign are one rotation."""
    np.testing.assert_allclose(np.abs((found * wanted).sum(1)), 1, atol=axes)


@pytest.mark.parametrize("degree", range(4))
def test_spz_of_gsply_is_turned_into_the_axes_of_a_ply(tmp_path, degree):
    """Half a turn about x: centres, rotations and colours as seen from the same side."""
    import gsply

    p = given(degree)
    theirs = gsply.GSData(
        means=p["means"], scales=p["log_scales"], quats=p["quats"], opacities=p["logit_opacities"],
        sh0=p["sh0"][:, 0], shN=p["shN"][:, : ply.REST[degree]], masks=None, mask_names=None,
        _base=None,
    )  # fmt: skip
    gsply.write_spz(tmp_path / "a.spz", theirs)
    found, found_degree, labels = read_splats(tmp_path / "a.spz")
    assert (found_degree, labels) == (degree, None)
    half = np.diag([1.0, -1, -1])
    assert np.abs(found["means"] - p["means"] @ half).max() < 1 / 4096
    assert np.abs(found["log_scales"] - p["log_scales"]).max() <= 0.51 / 16
    assert np.abs(expit(found["logit_opacities"]) - expit(p["logit_opacities"])).max() < 0.51 / 255
    assert np.abs(found["sh0"] - p["sh0"]).max() < 0.51 / 255 / 0.15
    alike(found["quats"], p["quats"] * [1, 1, -1, -1])
    looks = np.random.default_rng(2).normal(size=(50, 3))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    seen, turned = (basis(torch.from_numpy(d), 3)[:, 1:].numpy() for d in (looks, looks @ half))
    colors = (
        np.einsum("dk,nkc->ndc", turned, found["shN"]),
        np.einsum("dk,nkc->ndc", seen, p["shN"]),
    )
    assert np.abs(colors[0] - colors[1]).max() < 0.6 / 128 * np.abs(seen).sum(1).max()


def test_spz_of_version_2_holds_quaternions_of_three_bytes(tmp_path):
    """Written here by its specification."""
    p = given(0)
    fixed = np.round(p["means"] * 4096).astype("<i4").view(np.uint8).reshape(N, 3, 4)[..., :3]
    quats = p["quats"] * np.sign(p["quats"][:, :1])
    planes = [
        fixed,
        np.full(N, 255),
        np.full((N, 3), 128),
        np.full((N, 3), 96),
        np.round((quats[:, 1:] + 1) * 127.5),
    ]
    body = b"".join(np.asarray(plane).astype(np.uint8).tobytes() for plane in planes)
    (tmp_path / "a.spz").write_bytes(
        gzip.compress(struct.pack("<4sIIBBBx", b"NGSP", 2, N, 0, 12, 0) + body, mtime=0)
    )
    found = read_splats(tmp_path / "a.spz")[0]
    assert np.abs(found["means"] - p["means"] * [1, -1, -1]).max() < 0.51 / 4096
    alike(found["quats"], quats * [1, 1, -1, -1], 0.02)  # three bytes tell little where w is small
    assert (found["log_scales"] == -4).all() and (found["logit_opacities"] == 20).all()


def test_a_splat_of_32_bytes_a_gaussian_reads(tmp_path):
    p = given(0)
    rows = np.zeros(N, [("a", "<f4", 6), ("b", "u1", 8)])
    rows["a"] = np.concatenate([p["means"], np.exp(p["log_scales"])], 1)
    colors = (p["sh0"][:, 0] * 0.28209479 + 0.5).clip(0, 1)
    rgba = np.concatenate([colors, expit(p["logit_opacities"])[:, None]], 1)
    rows["b"] = np.concatenate([np.round(255 * rgba), np.round(p["quats"] * 127 + 128)], 1)
    (tmp_path / "a.SPLAT").write_bytes(rows.tobytes())
    found, degree, _ = read_splats(tmp_path / "a.SPLAT")
    assert degree == 0 and not found["shN"].any()
    assert np.array_equal(found["means"], p["means"])
    np.testing.assert_allclose(found["log_scales"], p["log_scales"], atol=1e-5)
    assert np.abs(found["sh0"][:, 0] * 0.28209479 + 0.5 - colors).max() < 0.51 / 255
    alike(found["quats"] / np.linalg.norm(found["quats"], axis=1, keepdims=True), p["quats"])


@pytest.mark.parametrize(("name", "content", "word"), [
    ("a.ksplat", b"any", "export it as PLY, for example with SuperSplat"),
    ("a.SOG", b"any", r"\.sog is not read \(\.ply, \.spz, \.splat are\)"),
    ("a.splat", bytes(33), "no multiple of 32"),
    ("a.spz", b"any", "is cut or no SPZ"),
    ("a.spz", struct.pack("<4sIIBBBx", b"NGSP", 4, 1, 0, 12, 0) + bytes(16),
     r"\(b'NGSP', version 4\); export"),
    ("a.spz", gzip.compress(struct.pack("<4sIIBBBx", b"NGSP", 1, 1, 0, 12, 0), mtime=0),
     "no SPZ of version 2 or 3"),
    ("a.spz", gzip.compress(struct.pack("<4sIIBBBx", b"NGSP", 3, 2**32 - 1, 3, 12, 0), mtime=0),
     "is cut, or has more"),
    ("a.spz", gzip.compress(bytes(9), mtime=0)[:-9], "no SPZ"),
])  # fmt: skip
def test_what_is_no_splat_that_is_read_says_what_to_do(tmp_path, name, content, word):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=word):
        read_splats(tmp_path / name)


def test_of_a_folder_of_3dgs_the_last_iteration_is_taken(tmp_path):
    with pytest.raises(InputError, match="point_cloud/iteration"):
        read_splats(tmp_path)
    for step in (7000, 30000, 9000):
        (tmp_path / f"point_cloud/iteration_{step}").mkdir(parents=True)
        p = given() | {"logit_opacities": np.full(N, step / 1e4, np.float32)}
        ply.write_ply(tmp_path / f"point_cloud/iteration_{step}/point_cloud.ply", p, 3)
    assert read_splats(tmp_path)[0]["logit_opacities"][0] == 3
    assert (
        is_splat(str(tmp_path))
        and all(is_splat(f"a{end}") for end in READ)
        and not is_splat("office0")
    )


def test_the_3d_filter_of_mip_splatting_is_fused_and_said(tmp_path, caplog):
    """Its own formulas, in plain numpy; GOF and RaDe-GS keep theirs alike."""
    p, size = given(), np.abs(np.random.default_rng(3).normal(size=N)).astype(np.float32)
    size[0] = 0
    with caplog.at_level(logging.INFO, "chebsplat"):
        found = read_splats(changed(tmp_path / "a.ply", p, more={"filter_3D": size}))[0]
    squares = np.exp(2 * p["log_scales"].astype(float))
    wide = squares + size[:, None].astype(float) ** 2
    opacity = expit(p["logit_opacities"].astype(float)) * np.sqrt(squares.prod(1) / wide.prod(1))
    np.testing.assert_allclose(found["log_scales"], 0.5 * np.log(wide), atol=1e-5)
    np.testing.assert_allclose(found["logit_opacities"], logit(opacity), atol=1e-5)
    assert "filter_3D is fused" in caplog.text


def test_discs_of_2dgs_are_thin_across_their_two_scales(tmp_path):
    p = given()
    found = read_splats(changed(tmp_path / "a.ply", p, rename=["scale_2"]))[0]["log_scales"]
    assert np.array_equal(found[:, :2], p["log_scales"][:, :2])
    np.testing.assert_allclose(found[:, 2], p["log_scales"][:, :2].min(1) + np.log(1e-3), atol=1e-5)


def test_a_few_gaussians_that_are_not_finite_are_dropped_and_counted(tmp_path, caplog):
    p = given()
    p["log_scales"][3, 1] = -np.inf
    p["means"][4] = p["quats"][5] = np.nan
    labels = np.arange(N)
    ply.write_ply(tmp_path / "a.ply", p, 3, labels)
    found, _, kept = read_splats(tmp_path / "a.ply")
    assert kept.tolist() == [k for k in range(N) if k not in (3, 4, 5)]
    assert all(np.array_equal(found[name], np.delete(p[name], [3, 4, 5], 0)) for name in found)
    assert "3 of 40 Gaussians are not finite" in caplog.text
    p["means"][: N - 5] = np.nan
    ply.write_ply(tmp_path / "a.ply", p, 3)
    with pytest.raises(InputError, match="means holds non-finite values in 35 rows"):
        read_splats(tmp_path / "a.ply")
