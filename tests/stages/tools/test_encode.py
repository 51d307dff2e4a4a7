"""The exported encoder keeps its contract: what torch says, onnxruntime says, and `chebsplat encode` needs no torch."""

import json
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from click.testing import CliRunner
from shared import ROOT

from chebsplat.formats.encoder import DYNAMIC, FLOAT, FUSED, read_encoder
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.ply import read_ply, write_ply
from chebsplat.formats.scene import Scene
from chebsplat.pipelines.cli import main
from chebsplat.settings import DescribeSection
from chebsplat.shape.encoder import RegionEncoder
from chebsplat.shape.region_inputs import Tokens, region_inputs
from chebsplat.stages.onnx import compare, example, fusion_example, quantize, restored_fusion
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.shape_models.point_graph import contract
from chebsplat.stages.shape_models.region_graph import encoder_model
from chebsplat.stages.training.saves import trained_with

pytestmark = pytest.mark.xdist_group("toy")

SHAPES = [(1, 1), (1, 17), (23, 1), *np.random.default_rng(0).integers(1, 65, (47, 2)).tolist()]


def run(*arguments):
    return CliRunner().invoke(main, ["encode", *map(str, arguments)])


def loaded(path):
    with np.load(path) as file:
        return dict(file)


def opened(path):
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def restored(toy):
    held = Gaussians.read(toy["train"])
    encoder = RegionEncoder.restored(*held.encoder())
    return encoder, restored_fusion(held, encoder.n_channels, trained_with(toy["train"])["train"])


def test_encoder_and_fusion_equal_torch_at_50_shapes(toy):
    encoder, fusion = restored(toy)
    encode, fuse = (opened(toy["onnx"] / name) for name in (FLOAT, FUSED))
    worst = np.zeros(3)
    for seed, shape in enumerate(SHAPES):
        given, behind = example(encoder, *shape, seed), fusion_example(encoder.n_channels, *shape, seed)
        given["mask"] &= torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < 0.8
        with torch.no_grad():
            wanted = [encoder(*given.values()), *fusion(*behind.values())]
        found = encode.run(None, {k: v.numpy() for k, v in given.items()})
        found += fuse.run(None, {k: v.numpy() for k, v in behind.items()})
        assert [f.shape for f in found] == [tuple(w.shape) for w in wanted]
        worst = np.maximum(worst, [np.abs(f - w.numpy()).max() for f, w in zip(found, wanted, strict=True)])
    assert len(SHAPES) == 50
    assert (worst < 1e-5).all(), worst


def test_models_do_not_say_where_they_were_made(toy):
    for path in [*toy["onnx"].glob("*.onnx"), ROOT / "teachers" / "embedded.onnx"]:
        assert b"site-packages" not in path.read_bytes()


def test_the_quantised_encoder_is_smaller_and_its_error_is_on_record(toy):
    encoder, _ = restored(toy)
    given = {k: v.numpy() for k, v in example(encoder, 32, 16).items()}
    exact, rough = (opened(toy["onnx"] / name).run(None, given)[0] for name in (FLOAT, DYNAMIC))
    assert 0 < np.abs(rough - exact).max() < 0.1 * np.abs(exact).max()
    assert (toy["onnx"] / DYNAMIC).stat().st_size < (toy["onnx"] / FLOAT).stat().st_size
    parity = read_encoder(toy["onnx"]).parity
    assert all(row["difference"] < 1e-5 for name in (FLOAT, FUSED) for row in parity[name])
    assert all(0 < row["difference"] < 0.2 for row in parity[DYNAMIC])


def test_contract_is_what_the_models_take_and_give_and_lies_in_their_metadata(toy):
    contract = json.loads((toy["onnx"] / "contract.json").read_text())
    types = {"tensor(float)": "float32", "tensor(bool)": "bool", "tensor(int64)": "int64"}
    seen = []
    for part in ("encoder", "fusion"):
        for name in contract[part]["files"]:
            runner = opened(toy["onnx"] / name)
            for kind, entries in (("inputs", runner.get_inputs()), ("outputs", runner.get_outputs())):
                said = contract[part][kind]
                assert [e.name for e in entries] == list(said)
                for entry in entries:
                    assert types[entry.type] == said[entry.name]["dtype"]
                    assert entry.shape == said[entry.name]["shape"]
                    assert said[entry.name]["meaning"]
            held = runner.get_modelmeta().custom_metadata_map["chebsplat.contract"]
            assert json.loads(held) == contract
            seen.append(name)
    assert set(seen) == {FLOAT, DYNAMIC, FUSED}


def test_encode_gives_the_scene_s_fused_features_without_torch(toy, mixed, tmp_path):
    checkpoint, path = mixed
    scene = Scene.read(path)
    assert not np.array_equal(scene.order, np.arange(len(scene.order)))
    program = (
        "import sys; sys.modules['torch'] = None\n"
        "from chebsplat.pipelines.cli import main\n"
        f"main(['encode', {str(path)!r}, '--encoder', {str(toy['onnx'])!r}, '--out', {str(tmp_path / 'a.npz')!r}])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'a.npz'}\n"), done.stderr
    found = loaded(tmp_path / "a.npz")
    shape = checkpoint.parameters["fused"] - checkpoint.parameters["features"]
    assert np.abs(shape).max() > 1e-3  # fusion does something
    assert np.abs(found["fused"] - scene.parameters["features"]).max() < 1e-4
    assert np.abs(found["fused"] - checkpoint.parameters["fused"][scene.order]).max() < 1e-4
    centres = scene.parameters["means"][found["centers"]]
    members = found["members"]
    far = np.linalg.norm(scene.parameters["means"][members] - centres[:, None], axis=-1)
    assert np.array_equal(members[:, 0], found["centers"])
    assert far[members >= 0].max() <= found["radius"] * (1 + 1e-6)
    assert ((found["gate"] > 0) & (found["gate"] <= 1)).all()


def test_the_quantised_model_is_chosen_by_naming_it(toy, tmp_path):
    for name in (FLOAT, DYNAMIC):
        assert run(toy["export"], "--encoder", toy["onnx"] / name, "--out", tmp_path / f"{name}.npz").exit_code == 0
    exact, rough = (loaded(tmp_path / f"{name}.npz")["fused"] for name in (FLOAT, DYNAMIC))
    assert 0 < np.abs(rough - exact).max() < 0.1


def test_a_ply_with_features_encodes_like_its_scene(toy, tmp_path):
    scene = Scene.read(toy["export"])
    p, degree, _ = read_ply(toy["export"] / "scene.ply")
    trained = np.argsort(scene.order)  # the regions depend on the order, of which a PLY says nothing
    write_ply(tmp_path / "scene.ply", {name: values[trained] for name, values in p.items()}, degree)
    np.save(tmp_path / "raw.npy", scene.parameters["raw_features"][trained])
    given = ["--features", tmp_path / "raw.npy", "--encoder", toy["onnx"]]
    assert run(tmp_path / "scene.ply", *given, "--out", tmp_path / "a.npz").exit_code == 0
    assert np.abs(loaded(tmp_path / "a.npz")["fused"] - scene.parameters["features"][trained]).max() < 1e-4


def test_one_gaussian_is_a_region_of_one(toy, tmp_path):
    p, degree, _ = read_ply(toy["export"] / "scene.ply")
    write_ply(tmp_path / "one.ply", {name: values[:1] for name, values in p.items()}, degree)
    np.save(tmp_path / "one.npy", np.ones((1, 13), np.float32))
    given = ["--features", tmp_path / "one.npy", "--encoder", toy["onnx"]]
    done = run(tmp_path / "one.ply", *given, "--out", tmp_path / "a.npz")
    assert done.exit_code == 0, done.stderr
    found = loaded(tmp_path / "a.npz")
    assert found["fused"].shape == (1, 13)
    assert np.isfinite(found["fused"]).all()


def test_arguments_that_do_not_fit_are_errors_that_name_the_remedy(toy, tmp_path):
    ply, out, onnx = toy["export"] / "scene.ply", ("--out", tmp_path / "a.npz"), ("--encoder", toy["onnx"])
    n = len(read_ply(ply)[0]["means"])
    for name, shape in (("narrow", (n, 5)), ("right", (n, 13))):
        np.save(tmp_path / f"{name}.npy", np.zeros(shape, np.float32))
    (tmp_path / "there.npz").write_text("mine")
    cases = [
        (2, "--features", [ply, *onnx, *out]),
        (2, "for a PLY", [toy["export"], *onnx, "--features", tmp_path / "right.npy", *out]),
        (3, "5 feature channels", [ply, *onnx, "--features", tmp_path / "narrow.npy", *out]),
        (2, "neither", [toy["export"], "--encoder", tmp_path / "mine.onnx", *out]),
        (3, "no finished", [toy["export"], "--encoder", tmp_path, *out]),
        (3, "expected chebsplat.scene", [toy["train"], *onnx, *out]),
        (2, ".npz", [toy["export"], *onnx, "--out", tmp_path / "a.zarr"]),
        (2, "exists", [toy["export"], *onnx, "--out", tmp_path / "there.npz"]),
        (2, "onnxruntime-gpu", [toy["export"], *onnx, *out, "--device", "cuda"]),
    ]
    for code, message, arguments in cases:
        done = run(*arguments)
        assert (done.exit_code, message in done.stderr) == (code, True), (message, done.stderr)
    assert not (tmp_path / "a.npz").exists()


def test_a_cut_spectrum_and_an_empty_scene_are_refused_by_name():
    describe = DescribeSection(n_regions=2, region_size=4, spectrum="taper")
    tokens = Tokens(2, described=True, context=False)
    rows = [np.ones((3, k), np.float32) for k in (3, 4, 3, 2)]
    with pytest.raises(ValueError, match=r"spectrum = taper, .* computed by torch only"):
        region_inputs(*rows, describe, tokens)
    with pytest.raises(ValueError, match="no Gaussians"):
        region_inputs(*(row[:0] for row in rows), describe, tokens)


VARIANTS = [{"n_layers": 0}, {"n_inputs": 0}, {"n_inputs": 5, "n_layers": 1}, {"n_positions": 6}]


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_kind_of_encoder_exports_and_keeps_its_contract(tmp_path, variant):
    torch.manual_seed(0)
    encoder = RegionEncoder(**({"n_inputs": 9, "n_channels": 4} | variant)).eval()
    onnx.save(encoder_model(encoder), tmp_path / "a.onnx")
    quantize(tmp_path / "a.onnx", tmp_path / "b.onnx")
    position = "both" if encoder.n_positions == 6 else "center"
    config = Config.model_validate({"train": {"position": position}}).sections(("describe", "train"))
    said = contract(encoder, config)["encoder"]["inputs"]
    found = {entry.name: entry.shape for entry in opened(tmp_path / "a.onnx").get_inputs()}
    assert found == {name: entry["shape"] for name, entry in said.items()}
    for shape in SHAPES[:10]:
        given = example(encoder, *shape)
        assert compare(encoder, tmp_path / "a.onnx", given) < 1e-5
        assert compare(encoder, tmp_path / "b.onnx", given) < 0.2
