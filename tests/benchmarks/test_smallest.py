"""Every benchmark runs to its end at its smallest size, and ends with 1 where a bar of it is
missed.
"""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from furniture_library import write_library
from PIL import Image
from shared import ROOT, data

import benchmarks.__main__ as bench
from benchmarks import raster, shared
from benchmarks.scenes import lenses
from benchmarks.training import cost
from chebsplat.stages.settings import TeachSection
from chebsplat.synthetic.rays import intrinsics

SETTINGS = (
    "teacher.kind=embedded,knowledge.start=shipped,train.steps=60,evaluate.timing_repeats=1,"
    "sfm.max_points=6000"
)
# of a finished toy scene: {work}, its folder of links, and {name}; {photos}: folder of a capture
SMALLEST = {
    "raster": "--rounds 1",
    "cost": "--work {work} --steps 20",
    "descriptor": "--repeats 1",
    "lift": "--work {work} --rounds 1",
    "refine": "--work {work}",
    "trust": "--scenes toy",
    "mesh": "--work {work} --voxels 0.05",
    "label": "--scenes toy --steps 20",
    "teaching": "--rooms 1 --held-out 1 --seeds 0 --steps 3 --rooms-in {out}/rooms",
    "lessons": "--scenes {name} {name}",
    "opensplat": "--scenes toy --seconds 3 --binary {standin}",
    "unposed": "{photos}",
    "lenses": "--views 1",
    "query": "--folders {work}",
    "sheets": "--furniture {furniture} --rooms 1",
    "stability": "--only pruning",
}
PRINT_ALONE = ("cost", "unposed", "lenses", "sheets")
BY_ITSELF = {"gpu"}  # test_what_awaits_a_gpu_runs_to_its_end_where_the_cpu_stands_in


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """The links of a toy scene that is finished with all that a benchmark reads; CHEBSPLAT_WORK is
    theirs.
    """
    store = tmp_path_factory.mktemp("work")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("CHEBSPLAT_WORK", str(store))
        command = [
            sys.executable,
            "-m",
            "chebsplat.pipelines.cli",
            "run",
            "--scene",
            "toy",
            "--set",
            SETTINGS,
        ]
        done = subprocess.run([*command, "--cores", "2"], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        yield next(store.glob("toy@*"))


@pytest.fixture(autouse=True)
def as_many_threads(monkeypatch):
    """Benchmarks set how many threads compute; the tests after them have theirs again."""
    import torch

    from chebsplat.kernels.threads import set_n_threads

    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)
    set_n_threads(0)


def capture_of_photos(folder):
    """Twelve real photos, small."""
    (folder / "images").mkdir(parents=True)
    for file in sorted((data("captures") / "lunddoor/images").iterdir()):
        with Image.open(file) as photo:
            photo.thumbnail((640, 640))
            photo.save(folder / "images" / file.name)
    return folder


STANDIN = """
import sys, time
from pathlib import Path
import numpy as np, pycolmap
from chebsplat.formats.ply import write_ply
folder, out = Path(sys.argv[1]), Path(sys.argv[sys.argv.index("-o") + 1])
model = pycolmap.Reconstruction(folder / "sparse/0")
means = np.array([point.xyz for point in model.points3D.values()], np.float32)
parameters = {"means": means, "log_scales": np.full((len(means), 3), -4, np.float32)}
parameters["quats"] = np.tile(np.float32([1, 0, 0, 0]), (len(means), 1))
parameters["logit_opacities"] = np.zeros(len(means), np.float32)
parameters |= {"sh0": np.zeros((len(means), 1, 3), np.float32)}
parameters["shN"] = np.zeros((len(means), 15, 3), np.float32)
for step in range(10, 100_000, 10):
    print(f"Step {step}: 0.1 (0%)", flush=True)
    write_ply(out.with_name(f"splat_{step}.ply"), parameters, 3)
    time.sleep(0.3)
"""


def opensplat_standin(folder):
    """A program that is called and prints as OpenSplat, and trains nothing."""
    path = folder / "opensplat"
    path.write_text(f"#!{sys.executable}{STANDIN}")
    path.chmod(0o755)
    return path


@pytest.mark.slow
@pytest.mark.xdist_group("benchmarks")
@pytest.mark.parametrize("name", sorted(bench.BENCHMARKS.keys() - BY_ITSELF))
def test_a_benchmark_runs_to_its_end_at_its_smallest_size(name, work, tmp_path, monkeypatch):
    photos = capture_of_photos(tmp_path / "photos") if name == "unposed" else ""
    words = {"work": work, "name": work.name, "out": tmp_path, "photos": photos}
    words["standin"], words["furniture"] = opensplat_standin(tmp_path), write_library(tmp_path)
    if name == "teaching":
        from benchmarks.teachers import teaching

        monkeypatch.setattr(teaching, "TeachSection", lambda: TeachSection(n_views=6, n_points=400))
    if name == "mesh" and not importlib.util.find_spec("pymeshlab"):
        from benchmarks.scenes import mesh

        monkeypatch.setattr(mesh, "cleaned", lambda made, *_: made)
    arguments = [word.format(**words) for word in SMALLEST[name].split()]
    code = bench.main([name, *arguments, "--out", str(tmp_path / "out")])
    assert code in (0, 1)  # by its bars, which are of whole scenes and quiet machines
    assert name in PRINT_ALONE or list((tmp_path / "out").glob("*.csv"))


@pytest.mark.parametrize("name", lenses.LENSES)
def test_a_lens_shows_each_point_where_its_equation_says(name):
    lens, K = lenses.LENSES[name], intrinsics(120, 90, 84.0)
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    photo = lenses.through(np.stack([x, y, 0 * x], -1), K, lens)
    bent = lenses.camera(K, lens, 120, 90)
    seen = lens.bend((photo[..., :2] - K[:2, 2]) / K[0, 0]) * bent[0, 0] + bent[:2, 2]
    inside = (
        slice(2, -2),
        slice(2, -2),
    )  # beyond the centres of the outermost pixels is no picture
    assert np.abs(seen - np.stack([x, y], -1))[inside].max() < 0.02
    assert np.abs(photo[..., 0] - x).max() > 3


def test_a_capture_that_exists_is_not_written_over(tmp_path, capsys):
    (tmp_path / "office31001-phone").mkdir()
    with pytest.raises(SystemExit, match="2"):
        lenses.main(["--views", "1", "--out", str(tmp_path)])
    assert "office31001-phone exists; remove it, or choose another" in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == ["office31001-phone"]


HELD = {"torch, 4 threads": 100.0, "cpu, 4 threads": 4.0, "cpu, 1 thread": 12.0,
        "cpu, 3 channels": 3.0, "cpu, 100k": 6.0, "training step, 3 colors": 10.0,
        "training step, 32 features by cell": 12.0}  # fmt: skip


@pytest.mark.parametrize(
    ("cores", "changed", "code"),
    [
        (4, {}, 0),
        (4, {"cpu, 100k": 9.0}, 1),
        (4, {"torch, 4 threads": 60.0}, 1),
        (4, {"cpu, 1 thread": 5.0}, 1),
        (2, {"cpu, 1 thread": 5.0}, 0),  # which four threads on two cores cannot
    ],
)
def test_the_rasterizer_s_benchmark_ends_with_1_where_a_bar_is_missed(
    tmp_path, monkeypatch, capsys, cores, changed, code
):
    def measured(variants, rounds):
        return dict.fromkeys(variants, 5.0) | HELD | changed

    monkeypatch.setattr(raster, "take_turns", measured)
    monkeypatch.setattr(raster.shared, "cores", lambda: cores)
    assert raster.main(["--out", str(tmp_path)]) == code
    assert ("MISSED" in capsys.readouterr().out) == bool(code)


@pytest.mark.parametrize(
    ("value", "relation", "met"),
    [(1.0, ">=", True), (0.9, ">=", False), (1.0, "<=", True), (1.1, "<=", False)]
    + [(float("nan"), relation, False) for relation in (">=", "<=")],
)
def test_a_bar_is_met_from_its_value_on_and_never_by_what_was_not_measured(
    capsys, value, relation, met
):
    assert shared.judged([("first", 1.0, "<=", 2.0), ("what", value, relation, 1.0)]) == [True, met]
    assert ("MISSED" in capsys.readouterr().out) == (not met)


@pytest.mark.parametrize(("ratio", "code"), [(1.2, 0), (1.3, 1), (float("nan"), 1)])
def test_the_cost_of_a_training_ends_with_1_where_its_bar_is_missed(
    tmp_path, monkeypatch, capsys, ratio, code
):
    monkeypatch.setattr(cost, "by_turns", lambda *_: {"plain": 1.0, "full": ratio, "other": 9.0})
    assert cost.main(["--work", str(tmp_path), "--ablations", "other"]) == code
    assert ("MISSED" in capsys.readouterr().out) == bool(code)
