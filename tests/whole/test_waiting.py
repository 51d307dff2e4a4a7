"""Who waits for a run of 120 photos is told before about how long, and never left in silence.

Seconds are those of a machine that runs nothing else: where processes of others want its cores,
too, each interval counts as much less as they leave (by the load of the last minute, as a machine's
own scenes correct its forecasts).
"""

import os
import re
import subprocess
import sys
import time
from itertools import chain, pairwise

import pytest
from PIL import Image

from chebsplat.stages.runtime.machine import load, processor
from chebsplat.stages.sources.generated import SIZES, photograph
from chebsplat.synthetic.rays import RayCaster, intrinsics, walk
from chebsplat.synthetic.shuffled import build

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("waiting")]
N_PHOTOS, SEED = 120, 3
SILENT, FACTOR = 10.0, 1.5  # s that a run may say nothing; by which a forecast may miss
UNITS = {"s": 1, "min": 60, "h": 3600}


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder of photos of a room as a phone leaves them."""
    folder, (_, *size) = tmp_path_factory.mktemp("waiting") / "photos", SIZES["room"]
    folder.mkdir()
    room, K = build("room", SEED), intrinsics(*size)
    caster = RayCaster(room.soup.vertices, room.soup.triangles)
    for k, pose in enumerate(walk(room.size, N_PHOTOS, SEED)):
        image, _, _ = photograph(room, caster, K, pose, *size)
        Image.fromarray(image).save(folder / f"IMG_{k:04d}.JPG", quality=92)
    return folder


@pytest.fixture(scope="module")
def heard(photos):
    """(seconds, line) of all that a run of the photos says on no terminal, as it arrives, by two
    cores; kernels are compiled before, once, which no forecast counts.
    """
    chebsplat = [sys.executable, "-P", "-m", "chebsplat.pipelines.cli"]
    subprocess.run([*chebsplat, "rehearse"], check=True)
    settings = ["--cores", "2", "--device", "cpu", "--set", "train.steps=200"]
    lines, seconds, last = [(0.0, "the command begins")], 0.0, time.monotonic()
    with subprocess.Popen(
        [*chebsplat, "run", "--scene", f"{photos}/", *settings],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"CHEBSPLAT_WORK": str(photos.parent / "work")},
    ) as run:
        for line in chain(run.stdout, ["the command ends"]):
            now = time.monotonic()
            seconds += (now - last) * min(1, os.cpu_count() / max(load(), 1))
            last = now
            lines.append((seconds, line.strip()))
    assert run.returncode == 0, lines[-10:]
    return lines


def test_nothing_is_silent_for_long(heard):
    gaps = [(after - before, said, then) for (before, said), (after, then) in pairwise(heard)]
    longest = max(gaps)
    print("longest silence: {:.1f} s, between {!r} and {!r}".format(*longest))
    assert longest[0] <= SILENT
    assert not [line for _, line in heard if re.match(r"[IWEF]\d{8} ", line)]  # COLMAP's own


@pytest.mark.skipif("EPYC" not in processor(), reason="forecasts begin as of an EPYC's cores")
def test_a_run_takes_about_as_long_as_its_first_line_says(heard):
    said = re.search(rf": {N_PHOTOS} photos, about ([\d.]+) (s|min|h) on 2 cores", heard[1][1])
    expected, taken = float(said[1]) * UNITS[said[2]], heard[-1][0]
    print(f"expected {expected:.0f} s, taken {taken:.0f} s, load {load():.1f}")
    assert 1 / FACTOR <= expected / taken <= FACTOR
