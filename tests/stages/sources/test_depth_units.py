"""Depth of any unit becomes z in the poses' unit, where points or other views tell it; else it is
refused.
"""

import json

import layouts
import numpy as np
import pytest
from shared import data
from source_folders import save

from chebsplat.cameras import unproject
from chebsplat.errors import DataFailure
from chebsplat.stages import ingest
from chebsplat.stages.settings import IngestSection, SourceSection
from chebsplat.stages.sources import colmap, depth_units, generated, transforms

UNIT = 0.37  # scene units of a metre
SCALED = [
    ("metres, and poses in another unit", lambda z: 1000 * z),
    ("five thousandths", lambda z: 5000 * z),
    ("tenths of a millimetre", lambda z: 10_000 * z),
    ("centimetres", lambda z: 100 * z),
]
INVERSE = [
    ("inverse", lambda z: 20_000 / z),
    ("inverse, with a shift", lambda z: 25_000 / z - 2000),
    (
        "inverse, 16 bits full",
        lambda z: 65_000 * (1 / z - 1 / z.max()) / (1 / z.min() - 1 / z.max()) + 1,
    ),
]
NONE = [
    ("of other views", lambda z: 1000 * np.roll(z, 5, 0)),
    ("the same everywhere", lambda z: np.full_like(z, 2000)),
    (
        "each view in its own unit",
        lambda z: 1000 * z * np.linspace(0.4, 2.5, len(z))[:, None, None] ** 2,
    ),
    ("of mirrored photos", lambda z: 1000 * z[:, :, ::-1]),
]


@pytest.fixture(scope="module")
def room():
    """A toy room in a reconstruction's own unit, its depth [V, H, W] in scene units, and points of
    its surface.
    """
    fields = generated.capture("toy", 1, "toy")
    fields["cam_from_world"] = fields["cam_from_world"].copy()
    fields["cam_from_world"][:, :3, 3] *= UNIT
    rng = np.random.default_rng(0)
    at = [rng.integers(0, side, (16, 40)) for side in fields["depth"].shape[1:]]
    poses, depth = fields["cam_from_world"], fields["depth"] * np.float32(UNIT)
    fields["points"] = np.concatenate(
        [
            unproject(depth[k], fields["Ks"][k], poses[k], np.stack([at[0][k], at[1][k]], 1))
            for k in range(16)
        ]
    )
    return fields


def write(folder, room, stored, with_points=False):
    """As COLMAP with points without tracks, or as transforms.json without any."""
    layouts.write_colmap(folder, room)
    rows = [f"{k} {x} {y} {z} 9 9 9 0.5\n" for k, (x, y, z) in enumerate(room["points"])]
    (folder / "sparse/0/points3D.txt").write_text("".join(rows))
    frames = []
    for name, values, pose in zip(room["names"], stored, layouts.world_from_cam(room), strict=True):
        save(folder / f"depth/{name}.png", values.round().clip(0, 65_535).astype(np.uint16))
        matrix = (pose * transforms.OPENGL).tolist()
        frames.append({"file_path": f"images/{name}.png", "depth_file_path": f"depth/{name}.png",
                       "transform_matrix": matrix})  # fmt: skip
    if not with_points:
        K, (height, width) = room["Ks"][0], stored.shape[1:]
        camera = {
            "w": width,
            "h": height,
            "fl_x": K[0, 0],
            "fl_y": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
        }
        (folder / "transforms.json").write_text(json.dumps(camera | {"frames": frames}))
    return SourceSection(kind="colmap" if with_points else "transforms", path=str(folder))


def metres(room):
    return room["depth"].astype(np.float64)


def off(found, room):
    """The median and the 95th percentile of |z / truth - 1| of what is known."""
    missed = np.abs(found / (metres(room) * UNIT) - 1)
    return np.nanquantile(missed, (0.5, 0.95))


@pytest.mark.parametrize("points", [True, False])
@pytest.mark.parametrize(
    ("name", "stored"), SCALED + INVERSE, ids=lambda value: value if isinstance(value, str) else ""
)
def test_depth_of_another_unit_becomes_that_of_the_poses_and_is_told(
    room, tmp_path, name, stored, points
):
    source = write(tmp_path, room, stored(metres(room)), points)
    fields = ingest.read("room", source, IngestSection())
    middle, most = off(fields["depth"], room)
    assert middle < 0.003  # the share of its depth that training takes for agreement
    assert most < 0.02  # of centimetres, which round by 1 % and more
    assert [note for note in fields["source"]["notes"] if "another unit than the poses" in note]
    assert "points" not in fields and "landmarks" not in fields
    assert np.isfinite(fields["depth"]).mean() > 0.99


@pytest.mark.parametrize("points", [True, False])
@pytest.mark.parametrize(
    ("name", "stored"), NONE, ids=lambda value: value if isinstance(value, str) else ""
)
def test_depth_that_fits_in_no_unit_is_refused_and_poses_and_photos_are_not(
    room, tmp_path, name, stored, points
):
    source = write(tmp_path, room, stored(metres(room)), points)
    with pytest.raises(
        DataFailure, match=r"the depth fits its poses in no unit.*ingest\.depth=off"
    ) as refused:
        ingest.read("room", source, IngestSection())
    assert str(tmp_path) in str(refused.value)
    without = ingest.read("room", source, IngestSection(depth="off"))
    # the model's own, which depth would have taken the place of
    assert ("points" in without) == points


@pytest.mark.parametrize("points", [True, False])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_depth_that_fits_stays_bit_for_bit(room, tmp_path, points, noise):
    stored = (
        1000 * UNIT * metres(room) * np.random.default_rng(0).normal(1, noise, room["depth"].shape)
    )
    fields = ingest.read("room", write(tmp_path, room, stored, points), IngestSection())
    assert np.array_equal(fields["depth"], np.round(stored).astype(np.float32) / np.float32(1000))
    assert not [note for note in fields["source"]["notes"] if "epth" in note]


@pytest.mark.parametrize(
    "codes",
    [(65_535,), (60_000,), (65_535, 60_000, 64_000), (1,), (0, 65_535)],
    ids=lambda codes: str(codes),
)
@pytest.mark.parametrize("factor", [1000, 5000])
def test_values_that_stand_for_unknown_are_found(room, tmp_path, codes, factor):
    stored, holes = factor * metres(room), np.zeros(room["depth"].shape, bool)
    for k, code in enumerate(codes):
        hole = np.s_[:, 10 * k : 10 * k + 8, :20]
        stored[hole], holes[hole] = code, True
    fields = ingest.read("room", write(tmp_path, room, stored), IngestSection())
    assert np.array_equal(np.isnan(fields["depth"]), holes)
    assert off(fields["depth"], room)[1] < 0.005
    named = [note for note in fields["source"]["notes"] if "stands for unknown" in note]
    assert len(named) == len(set(codes) - {0, 65_535})


def test_a_wall_at_one_depth_behind_what_varies_is_no_code():
    depth = np.random.default_rng(0).uniform(1, 2.2, (3, 40, 40)).astype(np.float32)
    depth[:, 20:] = 4
    fields = {"depth": depth.copy()}
    assert depth_units.codes(fields) == [] and np.array_equal(fields["depth"], depth)


@pytest.mark.parametrize("change", ["one view", "no poses", "small", "views that look away"])
def test_where_nothing_can_be_compared_nothing_is_said(room, change):
    fields = {name: room[name].copy() for name in ("depth", "cam_from_world", "Ks")} | {
        "source": {"notes": []}
    }
    if change == "no poses":
        fields["cam_from_world"] = None
    elif change == "views that look away":
        turns = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1]])
        fields = fields | {name: fields[name][:3] for name in ("depth", "cam_from_world", "Ks")}
        fields["cam_from_world"][:, :3, :3] = turns[:, None] * np.array(
            [np.eye(3), np.eye(3), np.eye(3)[[2, 1, 0]]]
        )
    else:
        end = np.s_[:1] if change == "one view" else np.s_[:, :5, :5]
        fields["depth"] = fields["depth"][end]
        n = len(fields["depth"])
        fields |= {name: fields[name][:n] for name in ("cam_from_world", "Ks")}
    before = fields["depth"].copy()
    depth_units.fit(fields, "here")
    assert np.array_equal(fields["depth"], before) and fields["source"]["notes"] == []


@pytest.mark.data
@pytest.mark.parametrize("factor", [1.0, 0.2])
def test_the_living_rooms_depth_fits_its_points_without_tracks(factor):
    """Of its 24,000 points a quarter is hidden in views that have them inside."""
    fields = colmap.read(data("house_living"), IngestSection(max_side=160, max_views=30))
    truth = fields["depth"].copy()
    fields["depth"] *= np.float32(factor)
    depth_units.fit(fields, "here")
    assert np.nanmedian(np.abs(fields["depth"] / truth - 1)) < 0.001
    assert (factor != 1) == (not np.array_equal(fields["depth"], truth, equal_nan=True))
