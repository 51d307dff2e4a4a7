"""Splats of other programs' formats hold what their specifications say, in the axes of a PLY
file.
"""

import gzip
import json
import logging
import struct
import zipfile

import numpy as np
import pytest
import torch
from numcodecs.zstd import Zstd
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit
from shared import gaussian_parameters

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats import ply
from chebsplat.formats.semantics import Semantics
from chebsplat.formats.splats import (
    READ,
    WRITTEN,
    is_splat,
    read_semantics,
    read_splats,
    write_splats,
)
from chebsplat.formats.world import World
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


def alike(found, wanted, axes=1e-5):
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


def covariances(p):
    turns = Rotation.from_quat(p["quats"], scalar_first=True).as_matrix()
    return np.einsum("nij,nj,nkj->nik", turns, np.exp(2 * p["log_scales"]), turns)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize(
    ("suffix", "centre", "shape", "opacity", "color", "light"),
    [
        (".spz", 1 / 8, 0.06, 0.51 / 255, 0.51 / 255 / 0.15, 1.01 / 128),
        (".sog", 3e-4, 0.01, 0.51 / 255, 1e-6, 1 / 80),
        (".glb", 1e-6, 1e-6, 1e-6, 1e-6, 1e-6),
    ],
)
def test_what_is_written_is_the_same_splat(
    tmp_path, suffix, centre, shape, opacity, color, light, degree
):
    """In another order, by other axes of the same ellipsoids, in the source's own world."""
    p = given(degree) | {"degrees": np.full(N, degree, np.uint8)}
    p["quats"][0] = 0  # as renderers have it: no turn
    world = World((4.0, -3.0, 2.0), 2.0)
    write_splats(tmp_path / f"a{suffix}", p, world=world)
    found, found_degree, labels = read_splats(tmp_path / f"a{suffix}")
    assert (found_degree, labels) == (degree, None)
    order = cKDTree(found["means"]).query(world.outward(p["means"]))[1]
    assert sorted(order) == list(range(N))
    found = {name: values[order] for name, values in found.items()}
    assert np.abs(found["means"] - world.outward(p["means"])).max() < centre
    p["quats"][0, 0] = 1
    sizes = np.exp(2 * p["log_scales"].max(1) + 2 * np.log(world.scale))[:, None, None]
    wanted = covariances(p | {"log_scales": p["log_scales"] + np.log(world.scale)})
    assert (np.abs(covariances(found) - wanted) / sizes).max() < shape
    assert np.abs(expit(found["logit_opacities"]) - expit(p["logit_opacities"])).max() < opacity
    assert np.abs(found["sh0"] - p["sh0"]).max() < color
    assert np.abs(found["shN"] - p["shN"]).max() < light


def test_a_stray_gaussian_costs_others_nothing_and_a_far_scene_is_refused(tmp_path):
    p = given() | {"degrees": np.full(N, 3, np.uint8)}
    stray = p | {"means": np.concatenate([p["means"][:-1], [[1e7, 0, 0]]]).astype(np.float32)}
    for name, parameters in (("a", p), ("b", stray)):
        write_splats(tmp_path / f"{name}.spz", parameters)
    near = [read_splats(tmp_path / f"{name}.spz")[0]["means"] for name in "ab"]
    assert (cKDTree(near[1]).query(near[0])[0] == 0).sum() >= N - 1
    for world in (World((4.5e7, 0, 0)), World((0, 0, 0), 1e4)):
        with pytest.raises(DataFailure, match=r"does not fit; export it as \.ply"):
            write_splats(tmp_path / "c.spz", p, world=world)
    with pytest.raises(ConfigError, match="name it so"):
        write_splats(tmp_path / "c.compressed.ply", p)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.spz", "b.spz"]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"version": 1}, "version 1"),
        ({"count": N + 1000}, "pixels for"),
        ({"means": {"files": []}}, "is cut or no SOG"),
        ({"sh0": {"codebook": [0.0], "files": ["sh0.webp"]}}, "is cut or no SOG"),
        ({"quats": {"files": ["meta.json"]}}, "is cut or no SOG"),
        ({"count": -3}, "-3 Gaussians"),
        (
            {"sh0": {"codebook": [[0.0, 1.0]] * 256, "files": ["sh0.webp"]}},
            "no codebook of numbers",
        ),
    ],
)
def test_a_sog_that_says_what_it_does_not_hold_is_refused(tmp_path, change, word):
    write_splats(tmp_path / "a.sog", given() | {"degrees": np.full(N, 3, np.uint8)})
    with (
        zipfile.ZipFile(tmp_path / "a.sog") as whole,
        zipfile.ZipFile(tmp_path / "b.sog", "w") as other,
    ):
        for name in whole.namelist():
            content = whole.read(name)
            if name == "meta.json":
                content = json.dumps(json.loads(content) | change).encode()
            other.writestr(name, content)
    with pytest.raises(InputError, match=word):
        read_splats(tmp_path / "b.sog")


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_of_version_4_is_streams_of_zstd(tmp_path, degree):
    """Written here by its specification, of what version 3 holds."""
    p = given(degree) | {"degrees": np.full(N, degree, np.uint8)}
    write_splats(tmp_path / "a.spz", p)
    plain = gzip.decompress((tmp_path / "a.spz").read_bytes())
    widths = [9, 1, 3, 3, 4, *[3 * ply.REST[degree]] * (degree > 0)]
    ends = 16 + N * np.cumsum(widths)
    streams = [plain[end - N * width : end] for end, width in zip(ends, widths, strict=True)]
    packed = [Zstd().encode(stream) for stream in streams]
    sizes = [struct.pack("<QQ", len(a), len(b)) for a, b in zip(packed, streams, strict=True)]
    header = struct.pack("<4sI", b"NGSP", 4) + plain[8:15]
    header += struct.pack("<BI12x4x", len(streams), 36)  # four bytes of an extension
    (tmp_path / "b.spz").write_bytes(header + b"".join([*sizes, *packed]))
    ours, theirs = (read_splats(tmp_path / f"{name}.spz")[0] for name in "ab")
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)


def meaning():
    """Three labels and none, a number of features that many of the Gaussians share."""
    rng = np.random.default_rng(4)
    features, rows = rng.normal(size=(9, 4)).astype(np.float16), rng.integers(0, 9, N)
    labels = np.arange(9)[rows] % 4 - 1
    words = rng.normal(size=(3, 4)).astype(np.float32)
    return Semantics.of(features[rows], labels, ["wall", "café", "sofa"], words)


@pytest.mark.parametrize("ending", ["spz", "sog"])
def test_a_stopped_export_leaves_no_splat_without_its_labels(tmp_path, monkeypatch, ending):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", stopped)
    with pytest.raises(KeyboardInterrupt):
        write_splats(
            tmp_path / f"a.{ending}", given(1) | {"degrees": np.ones(N, np.uint8)}, meaning()
        )
    assert not list(tmp_path.iterdir())


def parts_of(path):
    """The document of a GLB and the bytes after it."""
    raw = path.read_bytes()
    length, size = struct.unpack("<II", raw[8:16])
    assert length == len(raw)
    return json.loads(raw[20 : 20 + size]), raw[28 + size :]


def glb_of(path, document, binary):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    path.write_bytes(head + chunks + struct.pack("<I4s", len(binary), b"BIN\0") + binary)
    return path


def test_glb_holds_what_gltf_asks_for_of_gaussians(tmp_path):
    """Of its extensions in the axes of glTF, half a turn about x from those of a PLY."""
    p = given(1) | {"degrees": np.ones(N, np.uint8)}
    told, world = meaning(), World((1.0, 2.0, 3.0), 2.0)
    write_splats(tmp_path / "a.glb", p, told, world)
    document, binary = parts_of(tmp_path / "a.glb")
    mesh, used = document["meshes"][0], set(document["extensionsUsed"])
    assert used == {"KHR_gaussian_splatting", "EXT_mesh_features", "EXT_structural_metadata"}
    assert used == {*mesh["primitives"][0]["extensions"], *document["extensions"]}
    held = {}
    for name, k in mesh["primitives"][0]["attributes"].items():
        view, kind = document["bufferViews"][k], document["accessors"][k]["componentType"]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        held[name] = np.frombuffer(part, {5126: "<f4", 5123: "<u2"}[kind]).reshape(N, -1)
    own = {name.removeprefix("KHR_gaussian_splatting:"): v for name, v in held.items()}
    half = [1, -1, -1]
    np.testing.assert_allclose(own["POSITION"], world.outward(p["means"]) * half, rtol=1e-6)
    np.testing.assert_allclose(own["SCALE"], 2 * np.exp(p["log_scales"]), rtol=1e-5)
    quats = p["quats"] * [1, 1, -1, -1]
    np.testing.assert_allclose(own["ROTATION"], quats[:, [1, 2, 3, 0]], atol=1e-6)
    np.testing.assert_allclose(own["OPACITY"][:, 0], expit(p["logit_opacities"]), atol=1e-6)
    for k, sign in enumerate([-1, -1, 1]):  # of y, z, x
        assert np.array_equal(own[f"SH_DEGREE_1_COEF_{k}"], sign * p["shN"][:, k])
    assert not any("DEGREE_2" in name for name in own)
    assert np.array_equal(own["_FEATURE_ID_0"][:, 0], told.meanings)
    metadata = document["extensions"]["EXT_structural_metadata"]
    names = {row["value"]: row["name"] for row in metadata["schema"]["enums"]["label"]["values"]}
    assert names == {-1: "(none)", 0: "wall", 1: "café", 2: "sofa"}
    table = metadata["propertyTables"][0]["properties"]["label"]["values"]
    view = document["bufferViews"][table]
    assert view["byteOffset"] % 4 == 0
    assert np.array_equal(np.frombuffer(binary, "<i4", 9, view["byteOffset"]), told.labels)
    white = (p["sh0"][:, 0] * 0.28209479 + 0.5).clip(0, 1)
    shown = own["COLOR_0"] / 65535
    display = np.where(shown > 0.0031308, 1.055 * shown ** (1 / 2.4) - 0.055, 12.92 * shown)
    np.testing.assert_allclose(display[:, :3], white, atol=1e-3)
    assert np.abs(shown[:, 3] - own["OPACITY"][:, 0]).max() < 1e-4


@pytest.mark.parametrize("suffix", WRITTEN)
def test_what_gaussians_mean_travels_with_them(tmp_path, suffix):
    """In the order of the file; PLY has labels of its own, and nothing that words can ask."""
    path, p, told = tmp_path / f"a{suffix}", given() | {"degrees": np.full(N, 3)}, meaning()
    write_splats(path, p)
    assert read_semantics(path) is None
    write_splats(path, p, told)
    found, _, labels = read_splats(path)
    order = cKDTree(p["means"]).query(found["means"])[1]
    assert sorted(order) == list(range(N))
    wanted, known = told.labels[told.meanings][order], read_semantics(path)
    if suffix == ".ply":
        assert known is None and np.array_equal(labels, wanted)
        return
    assert np.array_equal(known.labels[known.meanings], wanted)
    assert np.array_equal(known.features[known.meanings], told.features[told.meanings][order])
    assert known.names == told.names and np.array_equal(known.embeddings, told.embeddings)


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"splat": np.array("0" * 64)}, "not of the a.spz beside it"),
        ({"labels": np.full(9, 3)}, "labels holds more than -1 to 2"),
        ({"meanings": np.full(N, -1)}, "meanings holds more than 0 to 8"),
        ({"features": np.full((9, 4), np.nan)}, "not finite"),
        ({"features": np.zeros((9, 3))}, "of different sizes"),
        ({"embeddings": np.array(["a"])}, "could not convert"),
        ({"names": None}, "'names'"),
    ],
)
def test_meanings_that_do_not_fit_are_refused(tmp_path, changed, word):
    path = tmp_path / "a.spz"
    write_splats(path, given() | {"degrees": np.full(N, 3)}, meaning())
    told = tmp_path / "a.spz.labels.npz"
    with np.load(told) as stored:
        arrays = {name: value for name, value in {**stored, **changed}.items() if value is not None}
    np.savez(told, **arrays)
    with pytest.raises(InputError, match=rf"labels\.npz does not fit .*{word}.*; remove it"):
        read_semantics(path)


@pytest.mark.parametrize("suffix", [".glb", ".spz"])
@pytest.mark.parametrize("names", [[1, 2, 3], ["wall", "", "sofa"], ["wall", "sofa", "sofa"]])
def test_class_names_that_are_none_are_refused(tmp_path, suffix, names):
    path, told = tmp_path / f"a{suffix}", tmp_path / f"a{suffix}.labels.npz"
    write_splats(path, given() | {"degrees": np.full(N, 3)}, meaning())
    if suffix == ".glb":
        document, binary = parts_of(path)
        values = document["extensions"]["EXT_structural_metadata"]["schema"]["enums"]["label"]
        for value, name in zip(values["values"][1:], names, strict=True):
            value["name"] = name
        glb_of(path, document, binary)
    else:
        with np.load(told) as stored:
            arrays = dict(stored) | {"names": np.array(names)}
        np.savez(told, **arrays)
    with pytest.raises(InputError, match=rf"a\{suffix}.*: names of classes.*; .* or export"):
        read_semantics(path)


@pytest.mark.parametrize("suffix", [".ply", ".sog", ".glb"])  # SPZ refuses such a scene
def test_sizes_beyond_float32_lose_no_gaussian(tmp_path, suffix):
    p = given(0) | {"degrees": np.zeros(N, np.uint8)}
    p["log_scales"][3], p["log_scales"][4, 0] = -120, 100
    write_splats(tmp_path / f"a{suffix}", p)
    assert len(read_splats(tmp_path / f"a{suffix}")[0]["means"]) == N


def splats_of(document):
    return document["meshes"][0]["primitives"][0]


def without(document, name):
    del splats_of(document)["attributes"][f"KHR_gaussian_splatting:{name}"]


def accessor(document, name, **changes):
    k = splats_of(document)["attributes"][name]
    document["accessors"][k] |= changes


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda d: splats_of(d)["extensions"].clear(), "0 primitives of Gaussians"),
        (lambda d: d["meshes"].append(d["meshes"][0]), "2 primitives of Gaussians"),
        (lambda d: d.clear(), "0 primitives of Gaussians"),
        (lambda d: without(d, "SCALE"), "no KHR_gaussian_splatting:SCALE"),
        (lambda d: without(d, "SH_DEGREE_1_COEF_2"), "no KHR_gaussian_splatting:SH_DEGREE_1"),
        (lambda d: accessor(d, "POSITION", componentType=5122), "POSITION is VEC3 of 5122"),
        (lambda d: accessor(d, "POSITION", type="VEC4"), "POSITION is VEC4"),
        (lambda d: accessor(d, "POSITION", count=N - 1), "of different lengths"),
        (lambda d: accessor(d, "POSITION", count=10**9), "size of buffer"),
        (lambda d: accessor(d, "POSITION", count="9"), "no GLB of Gaussians"),
        (lambda d: accessor(d, "POSITION", bufferView=99), "no GLB of Gaussians"),
        (lambda d: d["bufferViews"][3].update(byteOffset=0), "below 0"),
        (lambda d: d["nodes"][0].update(scale=[2, 2, 2]), "a node of it is moved"),
        (lambda d: accessor(d, "POSITION", sparse={"count": 1}), "POSITION is sparse"),
        (lambda d: accessor(d, "POSITION", type="VEC4", normalized=10**14), "VEC4 of 5126, norm"),
        (lambda d: d["bufferViews"][0].update(buffer=1), "lie in another file"),
        (lambda d: d["buffers"][0].update(uri="a.bin"), "lie in another file"),
        (lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]), "it needs EXT_mesh"),
        (
            lambda d: splats_of(d)["extensions"]["KHR_gaussian_splatting"].update(
                colorSpace="lin_rec709_display"
            ),
            "colours lin_rec709_display",
        ),
        (
            lambda d: splats_of(d)["extensions"]["KHR_gaussian_splatting"].update(
                extensions={"KHR_gaussian_splatting_compression_spz_2": {}}
            ),
            "packed by KHR_gaussian_splatting_compression_spz_2",
        ),
        (lambda d: d.update(meshes=[[]]), "no GLB of Gaussians"),
    ],
)
def test_a_glb_without_gaussians_that_are_read_says_so(tmp_path, change, word):
    write_splats(tmp_path / "a.glb", given(1) | {"degrees": np.ones(N, np.uint8)})
    document, binary = parts_of(tmp_path / "a.glb")
    change(document)
    with pytest.raises(InputError, match=rf"b\.glb .*{word}.*, or export it as PLY"):
        read_splats(glb_of(tmp_path / "b.glb", document, binary))


def test_a_glb_of_normalised_integers_between_others_reads(tmp_path):
    """Opacities and rotations as other writers quantise them, interleaved."""
    p = given(0) | {"degrees": np.zeros(N, np.uint8)}
    write_splats(tmp_path / "a.glb", p)
    document, binary = parts_of(tmp_path / "a.glb")
    rows = np.zeros(N, [("quats", "i1", 4), ("opacity", "<u2"), ("gap", "u1", 2)])
    quats = p["quats"][:, [1, 2, 3, 0]] * [1, -1, -1, 1]
    rows["quats"] = np.round(127 * quats)
    rows["opacity"] = np.round(65535 * expit(p["logit_opacities"]))
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": rows.nbytes, "byteStride": 8}
    views = len(document["bufferViews"])
    document["bufferViews"].append(view)
    name = "KHR_gaussian_splatting"
    accessor(document, f"{name}:ROTATION", bufferView=views, componentType=5120, normalized=True)
    changes = {"bufferView": views, "componentType": 5123, "normalized": True, "byteOffset": 4}
    accessor(document, f"{name}:OPACITY", **changes)
    found = read_splats(glb_of(tmp_path / "b.glb", document, binary + rows.tobytes()))[0]
    alike(found["quats"], p["quats"], 5e-3)  # of whole numbers, whose length is not 1
    np.testing.assert_allclose(found["logit_opacities"], p["logit_opacities"], atol=1e-3)


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
    # three bytes tell little where w is small
    alike(found["quats"], quats * [1, 1, -1, -1], 1e-3)
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
    alike(found["quats"] / np.linalg.norm(found["quats"], axis=1, keepdims=True), p["quats"], 3e-5)


def spz(version, n, degree):
    return struct.pack("<4sIIBBBx", b"NGSP", version, n, degree, 12, 0)


@pytest.mark.parametrize(("name", "content", "word"), [
    ("a.ksplat", b"any", "export it as PLY, for example with SuperSplat"),
    ("a.SOG", b"any", "is cut or no SOG of version 2"),
    ("a.glb", b"any", "is no GLB of Gaussians that is read"),
    ("a.glb", struct.pack("<4sIII4s", b"glTF", 1, 99, 9, b"JSON"), "no header of glTF 2"),
    ("a.glb", struct.pack("<4sIII4s", b"glTF", 2, 99, 1 << 30, b"JSON"), "1,073,741,824 bytes"),
    ("a.splat", bytes(33), "no multiple of 32"),
    ("a.spz", b"any", "is cut or no SPZ"),
    ("a.spz", spz(4, 1, 0) + bytes(16), "is cut or no SPZ of version 2 to 4"),
    ("a.spz", gzip.compress(spz(1, 1, 0), mtime=0), "version 1"),
    ("a.spz", gzip.compress(spz(4, 1, 0), mtime=0), "version 4"),
    ("a.spz", gzip.compress(spz(3, 2**32 - 1, 3), mtime=0), "it has more than"),
    ("a.spz", gzip.compress(spz(3, 5, 3), mtime=0), "is cut"),
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


def emptied(path):
    """A file of a format that holds no Gaussian, as its header says."""
    if path.suffix == ".ply":
        ply.write_ply(path, given(0), 0)
        head = path.read_bytes().partition(b"end_header\n")[0]
        path.write_bytes(head.replace(b"vertex %d" % N, b"vertex 0") + b"end_header\n")
    elif path.suffix == ".spz":
        path.write_bytes(gzip.compress(spz(3, 0, 1)[:16]))
    elif path.suffix == ".splat":
        path.write_bytes(b"")
    elif path.suffix == ".glb":
        write_splats(path, given(0) | {"degrees": np.zeros(N, np.uint8)})
        document, binary = parts_of(path)
        for part in document["accessors"]:
            part["count"] = 0
        glb_of(path, document, binary)
    else:
        write_splats(path, given(0) | {"degrees": np.zeros(N, np.uint8)})
        with zipfile.ZipFile(path) as whole:
            files = {name: whole.read(name) for name in whole.namelist()}
        meta = json.loads(files["meta.json"]) | {"count": 0}
        with zipfile.ZipFile(path, "w") as whole:
            for name, content in (files | {"meta.json": json.dumps(meta)}).items():
                whole.writestr(name, content)
    return path


@pytest.mark.parametrize("suffix", READ)
def test_a_file_without_gaussians_is_refused_as_such(tmp_path, suffix):
    with pytest.raises(InputError, match="holds no"):
        read_splats(emptied(tmp_path / f"none{suffix}"))


def test_a_quaternion_of_zero_is_read_as_no_rotation(tmp_path):
    p = given(0)
    p["quats"][3] = 0
    ply.write_ply(tmp_path / "a.ply", p, 0)
    quats = read_splats(tmp_path / "a.ply")[0]["quats"]
    np.testing.assert_array_equal(quats[3], [1, 0, 0, 0])
    np.testing.assert_array_equal(np.delete(quats, 3, 0), np.delete(p["quats"], 3, 0))


def test_a_scene_too_far_for_24_bits_is_refused_as_spz(tmp_path):
    p = given(0) | {"degrees": np.zeros(N, np.uint8)}
    p["means"] *= np.float32(1e8)
    with pytest.raises(DataFailure, match="does not fit"):
        write_splats(tmp_path / "far.spz", p)
