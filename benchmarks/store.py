"""The feature store against its bars: bytes a view, error and label decisions in the few channels, bandwidth, memory.

LSeg's weights cannot be had, so its features are stood in for: 512 channels at 360 x 480, maps of 150 words (a common
part, cosine about .75 between words, and a scatter whose variance falls as k^-a over the channels) that segments show,
mixed with their nearest words by smooth maps, blurred over boundaries, with smooth noise of a tenth of the length that
falls as k^-a too. How steep LSeg's own spectrum is, is not known: a = 3 and a = 1 are both measured. The embedded
teacher's features are its own, on rooms that it was not trained on.

Fails if a bar does.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from argparse import SUPPRESS
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from benchmarks import shared
from chebsplat.formats.artifact import publish
from chebsplat.formats.features import PATCH, SCHEMA, FeatureWriter, read_features
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.teacher_model import EMBEDDED
from chebsplat.labels.channels import ROWS, Moments, channel_map

SIZE, N_CHANNELS, N_WORDS = (360, 480), 512, 150
WIDTH = 32  # the default of channels.n_channels
WIDTHS = (13, 16, 24, 32, 48, 57)  # 57: the most that 20 MB a view hold before compression
REFERENCES = 24
MAX_BYTES, MAX_ERROR, MAX_GROWTH = 20e6, 0.01, 0.1


def stand_in(steepness: float) -> tuple[np.ndarray, Callable[[int, tuple[int, int]], np.ndarray]]:
    """Words [L, C], and a view's features by seed and size."""
    rng = np.random.default_rng(0)
    falling = np.arange(1, N_CHANNELS + 1) ** (-steepness / 2)
    falling /= np.linalg.norm(falling)
    axes = [np.linalg.qr(rng.normal(size=(N_CHANNELS, N_CHANNELS)))[0] * falling for _ in range(2)]
    common = rng.normal(size=N_CHANNELS)
    scatter = rng.normal(size=(N_WORDS, N_CHANNELS)) @ axes[0].T
    words = unit(0.87 * common / np.linalg.norm(common) + 0.5 * scatter).astype(np.float32)
    near = np.argsort(-(words @ words.T), 1)[:, 1:4]

    def view(seed: int, size: tuple[int, int]) -> np.ndarray:
        rng, (h, w) = np.random.default_rng(seed), size
        grain = h / 90
        centres, shown = rng.random((40, 2)) * size, rng.choice(N_WORDS, 12, replace=False)[rng.integers(0, 12, 40)]
        y, x = np.mgrid[:h, :w]
        word = shown[((y[..., None] - centres[:, 0]) ** 2 + (x[..., None] - centres[:, 1]) ** 2).argmin(-1)]
        shares = np.zeros((h, w, N_WORDS), np.float32)
        np.put_along_axis(shares, word[..., None], 1, -1)
        for k in range(near.shape[1]):
            part = np.clip(0.3 * smooth(rng, (h, w, 1), 6 * grain), 0, 1)
            shares *= 1 - part
            other = near[word, k][..., None]
            np.put_along_axis(shares, other, np.take_along_axis(shares, other, -1) + part, -1)
        shares = gaussian_filter(shares, (1.5 * grain, 1.5 * grain, 0))
        mixing = (rng.normal(size=(64, N_CHANNELS)) @ axes[1].T / 8).astype(np.float32)
        return unit(shares @ words + 0.1 * smooth(rng, (h, w, 64), 3 * grain) @ mixing)

    return words, view


def smooth(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> np.ndarray:
    """Smooth noise [h, w, n] of deviation 1."""
    found = gaussian_filter(rng.standard_normal(shape, np.float32), (sigma, sigma, 0))
    return found / found.std((0, 1))


def unit(values: np.ndarray) -> np.ndarray:
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def embedded(n_views: int) -> tuple[np.ndarray, Iterator[np.ndarray], Iterator[np.ndarray]]:
    """Words, features of the reference's views, features of views of a held-out room, of the embedded teacher."""
    from chebsplat.formats.teacher_model import read_label_table, read_teacher
    from chebsplat.stages.channels import VIEWS, generated
    from chebsplat.stages.command import n_threads
    from chebsplat.stages.teacher_inference import TeacherInference
    from chebsplat.synthetic.seeds import HELD_OUT, REFERENCE

    teacher = read_teacher(EMBEDDED)
    encoder = TeacherInference(teacher, n_threads())
    words = read_label_table(teacher.labels)[1] if teacher.labels else None
    assert words is not None

    def features(seeds: range) -> Iterator[np.ndarray]:
        for name, image in generated(seeds):
            yield encoder.features(image, encoder.grid(image, 4)[0], (1.0,), False, name)

    n_rooms = -(-n_views // VIEWS)
    return unit(words), features(REFERENCE[: REFERENCES // VIEWS]), features(HELD_OUT[:n_rooms])


def measured(name: str, words: np.ndarray, references: Iterator, views: list[np.ndarray], out: Path) -> list[dict]:
    """A row for each width, and one for the width of a scene by energy alone: what the vocabulary's weight is for."""
    moments = Moments(words.shape[1])
    for features in references:
        moments.add(features)
    cases = [(width, 1.0) for width in WIDTHS] + [(WIDTH, 0.0)]
    return [row(name, words, views, out, *channel_map(moments, words, *case)) | {"weight": case[1]} for case in cases]


def row(
    name: str, words: np.ndarray, views: list[np.ndarray], scratch: Path, matrix: np.ndarray, energy: np.ndarray
) -> dict:
    """What one width costs and keeps, on views that the channels were not computed from."""
    few = [(view @ matrix.astype(np.float32)) for view in views]
    lost, whole, same = 0.0, 0.0, []
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        out = Path(folder) / "features"
        names = [str(k) for k in range(len(few))]
        seconds = {"write": clock(lambda: write(out, names, iter(few), few[0].shape))}
        stored = read_features(out).features
        seconds["read"] = clock(lambda: [stored[k] for k in range(len(few))])
        seconds["patch"] = clock(lambda: [stored[k, :PATCH, :PATCH] for k in range(len(few))])
        size = sum(file.stat().st_size for file in (out / "features/c").rglob("*") if file.is_file()) / len(few)
        for k, view in enumerate(views):
            kept, full = stored[k].reshape(-1, matrix.shape[1]).astype(np.float32), view.reshape(-1, len(matrix))
            for start in range(0, len(full), ROWS):
                a, b = full[start : start + ROWS], kept[start : start + ROWS]
                lost += float(np.square(a - b @ matrix.T).sum(dtype=np.float64))
                whole += float(np.square(a).sum(dtype=np.float64))
                same.append((a @ words.T).argmax(1) == (b @ (words @ matrix).T).argmax(1))
    mega = few[0].astype(np.float16).nbytes * len(few) / 1e6
    return {
        "features": name,
        "shape": "x".join(map(str, views[0].shape)),
        "d": matrix.shape[1],
        "energy": round(float(energy[matrix.shape[1] - 1]), 6),
        "mb_a_view": round(size / 1e6, 3),
        "relative_error": round((lost / whole) ** 0.5, 5),
        "label_agreement": round(float(np.concatenate(same).mean()), 4),
        "write_mb_s": round(mega / seconds["write"], 1),
        "read_mb_s": round(mega / seconds["read"], 1),
        "view_ms": round(1e3 * seconds["read"] / len(few), 2),
        "patch_ms": round(1e3 * seconds["patch"] / len(few), 2),
    }


def clock(action: Callable[[], object]) -> float:
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


def write(out: Path, names: list[str], views: Iterator[np.ndarray], shape: tuple[int, int, int]) -> None:
    with publish(out, Manifest(SCHEMA, "0" * 16, "teacher")) as tmp:
        writer = FeatureWriter(out.parent / "writer", names, shape)
        for k, view in enumerate(views):
            writer.add(k, view)
        writer.finish(tmp, ["word"], np.eye(1, shape[2], dtype=np.float32), {})


def memory(what: str, folder: Path, n_views: int) -> int:
    """Peak bytes of a process that writes a store, or reads it as training does; called in a process of its own."""
    shape = (*SIZE, WIDTH)
    if what == "write":
        one = np.random.default_rng(0).standard_normal(shape, np.float32)
        views = (np.roll(one, k, 0) for k in range(n_views))
        write(folder / "features", [str(k) for k in range(n_views)], views, shape)
    else:
        import torch

        from chebsplat.stages.train_inputs import FEATURE_BYTES
        from chebsplat.views import remembered

        stored = read_features(folder / "features").features
        read = remembered(lambda k: torch.from_numpy(stored[k]), FEATURE_BYTES)
        for k in np.random.default_rng(0).permutation(n_views).tolist():
            read(k).float()
    return shared.peak_memory()


def memories(scratch: Path) -> list[dict]:
    """Peak megabytes of writing and of reading, for 20 and 200 views, each in a process of its own.

    Large blocks go back to the system as soon as they are freed: otherwise the peak is, now and then, that of what the
    allocator keeps for later, a view's size or two more.
    """
    rows, environment = [], os.environ | {"MALLOC_MMAP_THRESHOLD_": str(1 << 20)}
    for n_views in (20, 200):
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            for what in ("write", "read"):
                command = [sys.executable, "-m", "benchmarks", "store", "--memory", what, "--out", folder]
                command += ["--views", str(n_views)]
                done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
                peak = json.loads(done.stdout)
                rows.append({"features": f"{what} {n_views} views", "shape": f"360x480x{WIDTH}", "peak_mb": peak / 1e6})
    return rows


def bars_missed(rows: list[dict]) -> list[str]:
    """Bars that are not held. The stand-in of the shallow spectrum is measured, not judged."""
    best = [r for r in rows if r["features"] == "LSeg-like, a = 3" and r["relative_error"] <= MAX_ERROR]
    found = [] if best and best[0]["mb_a_view"] * 1e6 <= MAX_BYTES else ["20 MB a view at 1 % error"]
    peaks = {r["features"]: r["peak_mb"] for r in rows if "peak_mb" in r}
    for what in ("write", "read"):
        few, many = peaks[f"{what} 20 views"], peaks[f"{what} 200 views"]
        if abs(many / few - 1) > MAX_GROWTH:
            found.append(f"memory of {what}: {few:.0f} MB for 20 views, {many:.0f} MB for 200")
    return found


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("store", __doc__)
    parser.add_argument("--views", type=int, default=3, help="that error and bandwidth are measured on")
    parser.add_argument("--memory", choices=["write", "read"], help=SUPPRESS)  # of a process of its own, in --out
    options = parser.parse_args(arguments)
    if options.memory:
        print(json.dumps(memory(options.memory, options.out, options.views)))
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict] = []
    if EMBEDDED.is_file():
        words, references, held_out = embedded(options.views)
        rows += measured("embedded teacher", words, references, list(held_out), options.out)
    for steepness in (3, 1):
        words, view = stand_in(steepness)
        references = (view(1000 + k, (90, 120)) for k in range(REFERENCES))
        views = [view(k, SIZE) for k in range(options.views)]
        rows += measured(f"LSeg-like, a = {steepness}", words, references, views, options.out)
    rows += memories(options.out)
    columns = list(dict.fromkeys(column for r in rows for column in r))
    print(" | ".join(columns))
    for r in rows:
        print(" | ".join(str(round(r[c], 1) if c == "peak_mb" and c in r else r.get(c, "")) for c in columns))
    shared.write_csv(options.out / "store.csv", rows)
    missed = bars_missed(rows)
    print("bars: held" if not missed else "bars missed: " + "; ".join(missed))
    return int(bool(missed))
