"""The feature store: the same bytes in any order and after any kill; damage and bad values are
named.
"""

import json
import random
import subprocess
import sys
import time

import numpy as np
import pytest
from shared import published

from chebsplat.errors import InputError
from chebsplat.formats.features import Features, FeatureWriter

NAMES = ["a", "b", "c", "d"]
SHAPE = (70, 130, 3)
LABELS = (["wall", "floor"], np.eye(2, 3, dtype=np.float32), {"normalized": True})


def view(k, shape=SHAPE):
    rng = np.random.default_rng(k)
    size = shape[:2]
    return (
        rng.normal(size=shape).astype(np.float32),
        rng.integers(0, 2, size),
        rng.random(size, dtype=np.float32),
    )


def contents(folder):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def finished(writer, out):
    out.mkdir()
    writer.finish(out, *LABELS)
    return contents(out)


def written(folder, order, shape=SHAPE):
    writer = FeatureWriter(folder, NAMES, shape)
    for k in order:
        writer.add(k, *view(k, shape))
    return writer


@pytest.fixture
def whole(tmp_path):
    return finished(written(tmp_path / "whole", range(4)), tmp_path / "whole-out")


def test_order_and_repetition_leave_the_same_bytes(tmp_path, whole):
    assert finished(written(tmp_path / "w", [2, 0, 3, 0, 1, 2]), tmp_path / "out") == whole


def test_a_stack_written_at_once_has_the_bytes_of_its_views(tmp_path, whole):
    stacks = [np.stack(arrays) for arrays in zip(*map(view, range(4)), strict=True)]
    labels = dict(zip(("label_names", "label_embeddings", "convention"), LABELS, strict=True))
    (tmp_path / "out").mkdir()
    Features(NAMES, stacks[0], pseudo_labels=stacks[1], confidence=stacks[2], **labels).write(
        tmp_path / "out"
    )
    assert contents(tmp_path / "out") == whole


@pytest.mark.parametrize(
    "left", ["half a view", "no mark", "mark without files", "part of a mark", "no metadata"]
)
def test_whatever_a_kill_leaves_is_written_anew(tmp_path, whole, left):
    folder = tmp_path / "w"
    written(folder, [3, 1])
    chunk, mark = folder / "features/c.1.0.0.0", folder / "done/1"
    if left == "half a view":
        mark.unlink()
        chunk.write_bytes(chunk.read_bytes()[:50])
        (chunk.parent / "0.1234.partial").write_bytes(b"half")
    elif left == "no mark":
        mark.unlink()
    elif left == "mark without files":
        chunk.unlink()
    elif left == "part of a mark":
        mark.rename(mark.with_name(".tmp-999999999-1"))
    else:
        (folder / "features/zarr.json").unlink()
    writer = FeatureWriter(folder, NAMES, SHAPE)
    assert writer.finished == ({1, 3} if left == "no metadata" else {3})
    for k in set(range(4)) - writer.finished:
        writer.add(k, *view(k))
    assert finished(writer, tmp_path / "out") == whole


KILLED = """
import json, sys
import numpy as np
from pathlib import Path
from chebsplat.formats.features import FeatureWriter
views = np.load(sys.argv[1])
writer = FeatureWriter(Path(sys.argv[2]), json.loads(sys.argv[3]), views["features"].shape[1:])
print("ready", flush=True)
for k in sorted(set(range(len(writer.names))) - writer.finished):
    writer.add(k, views["features"][k], views["labels"][k], views["confidence"][k])
    print(k, flush=True)
"""


def test_killed_at_random_moments_it_goes_on_and_leaves_the_same_bytes(tmp_path, whole):
    rng, seen, code = random.Random(0), [], None
    stacks = [np.stack(arrays) for arrays in zip(*map(view, range(4)), strict=True)]
    np.savez(
        tmp_path / "views.npz",
        **dict(zip(("features", "labels", "confidence"), stacks, strict=True)),
    )
    command = [
        sys.executable,
        "-c",
        KILLED,
        tmp_path / "views.npz",
        tmp_path / "w",
        json.dumps(NAMES),
    ]
    for attempt in range(4):
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout.readline() == "ready\n"
            if attempt < 3:
                time.sleep(rng.uniform(0, 0.02))
                process.kill()
            seen += [int(line) for line in process.stdout]
        code = process.returncode
    assert code == 0
    assert len(seen) == len(set(seen)), "a view was done twice"
    assert finished(FeatureWriter(tmp_path / "w", NAMES, SHAPE), tmp_path / "out") == whole


@pytest.mark.parametrize(
    "other",
    [{"names": ["a", "b", "c", "e"]}, {"shape": (70, 131, 3)}, {"made_with": {"n_scales": 2}}],
    ids=lambda o: next(iter(o)),
)
def test_views_of_other_names_shape_or_settings_are_not_taken_over(tmp_path, other):
    written(tmp_path / "w", [0])
    assert FeatureWriter(tmp_path / "w", NAMES, SHAPE).finished == {0}
    assert (
        FeatureWriter(tmp_path / "w", **({"names": NAMES, "shape": SHAPE} | other)).finished
        == set()
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e6], ids=["nan", "inf", "too large"])
def test_a_value_that_float16_cannot_hold_is_refused_with_the_view(tmp_path, bad):
    writer, values = FeatureWriter(tmp_path / "w", NAMES, SHAPE), view(2)[0]
    values[3, 4, 1] = bad
    with pytest.raises(ValueError, match="view c: features hold 1 non-finite"):
        writer.add(2, values)
    assert writer.finished == set()


def test_a_wrong_shape_is_refused_with_the_view(tmp_path):
    with pytest.raises(ValueError, match=r"view b: features \(70, 130, 2\)"):
        FeatureWriter(tmp_path / "w", NAMES, SHAPE).add(1, view(1)[0][..., :2])


def test_a_store_that_lacks_a_view_or_its_labels_is_not_finished(tmp_path):
    writer = written(tmp_path / "w", [0, 2, 3])
    with pytest.raises(ValueError, match="view b was not added"):
        finished(writer, tmp_path / "one")
    writer.add(1, view(1)[0])
    with pytest.raises(ValueError, match="view b was added without confidence"):
        finished(writer, tmp_path / "two")


def test_a_bit_that_flips_in_any_byte_of_a_view_is_noticed(tmp_path):
    stack = np.zeros((1, 65, 65, 1), np.float16)  # compresses well: few bytes to try
    path = published(tmp_path / "f", Features(["a"], stack, ["x"], np.eye(1, 1, dtype=np.float32)))
    chunk = path / "features/c.0.0.0.0"
    good = chunk.read_bytes()
    found = Features.read(path).features
    for place in range(len(good)):
        chunk.write_bytes(
            good[:place] + bytes([good[place] ^ (1 << place % 8)]) + good[place + 1 :]
        )
        with pytest.raises(InputError, match="does not match its sha256"):
            found[0]
    chunk.write_bytes(good)
    assert np.array_equal(found[0], stack[0])
