"""Every protocol gives the figures that a person works out on paper, joins views by name, and tests
the right ones.
"""

import itertools

import numpy as np
import pytest
import torch
from PIL import Image

from chebsplat.errors import ConfigError, DataFailure
from chebsplat.evaluation import protocols
from chebsplat.evaluation.protocols import (
    deep_blending,
    labels,
    replica_f3,
    replica_gt,
    scannet_closed,
    scannet_open,
)
from chebsplat.evaluation.protocols.task import EvaluatedView, MapsByName, Task, bilinear, resized
from chebsplat.stages.ingest import every, renamed, split, thinned
from chebsplat.stages.runtime.config import build
from chebsplat.stages.settings import IngestSection

ADE = [replica_f3.SPELT.get(k, f"label_{k}") for k in range(1, 151)]
ADE[0] = "wall"
HEIGHT, WIDTH = replica_f3.LABELS


def one_hot(ids, n):
    return np.eye(n, dtype=np.float32)[np.asarray(ids)]


def view(ids, n, **fields):
    """A view of certain labels [H, W] among n."""
    ids = np.asarray(ids)
    return EvaluatedView(fields.pop("name", "a"), one_hot(ids, n), ids.astype(np.int16), **fields)


# splits


def test_the_split_counts_names_as_people_do_in_whatever_order_they_come():
    names = [f"rgb_{k}" for k in range(20)]
    for order in (names, sorted(names), names[::-1]):
        chosen = {name for name, test in zip(order, every(order, 8, 2), strict=True) if test}
        # as text, rgb_10 would come third and rgb_2 thirteenth
        assert chosen == {"rgb_2", "rgb_10", "rgb_18"}


@pytest.mark.parametrize(
    ("protocol", "tests"),
    [("labels", {0, 8, 16}), ("replica-f3", {2, 10, 18}), ("replica-gt", {2, 10, 18}),
     ("scannet-open", set()),
     ("scannet-closed", {0, 5, 10, 15}), ("deep-blending", {0, 8, 16})],
)  # fmt: skip
def test_each_protocol_has_its_own_test_views(protocol, tests):
    names = [str(k) for k in range(20)][::-1]
    found, record = split(names, None, IngestSection(protocol=protocol))
    assert {int(name) for name, test in zip(names, found, strict=True) if test} == tests
    assert record["name"] == protocol and record["split"]


@pytest.mark.parametrize("name", ["lables", "task", "replica_f3", ""])
def test_another_protocol_is_refused_with_the_names_that_there_are(name):
    with pytest.raises(ConfigError, match=r"^scene a: ingest\.protocol: it must be ") as error:
        build({"ingest": {"protocol": name}}, "scene a")
    assert all(f"'{known}'" in str(error.value) for known in protocols.NAMES)


@pytest.mark.parametrize(
    ("protocol", "side"), [("labels", 640), ("scannet-open", 648), ("deep-blending", 1600)]
)
def test_a_protocol_has_a_resolution_of_its_own_which_a_config_may_change(protocol, side):
    assert IngestSection(protocol=protocol).max_side == side
    assert IngestSection(protocol=protocol, max_side=320).max_side == 320


def test_only_labels_and_scannet_closed_follow_a_sources_own_split():
    names, own = [str(k) for k in range(20)], np.arange(20) == 7
    followed = {
        name
        for name in protocols.NAMES
        if np.array_equal(split(names, own, IngestSection(protocol=name))[0], own)
    }
    assert followed == {"labels", "scannet-closed"}


def test_the_offset_of_deep_blending_may_be_set_and_is_recorded_and_that_of_replica_may_not():
    names = [str(k) for k in range(20)]
    found, record = split(names, None, IngestSection(protocol="deep-blending", test_offset=2))
    assert np.flatnonzero(found).tolist() == [2, 10, 18]
    assert (record["test_every"], record["test_offset"]) == (8, 2)
    with pytest.raises(ConfigError, match="replica-f3 tests other views"):
        split(names, None, IngestSection(protocol="replica-f3", test_offset=0))


# labels, replica-gt


def test_labels_on_paper():
    # truth      wall wall  floor floor      wall:  1 right, 1 missed, 0 wrong -> IoU 1/2, recall
    # 1/2 predicted  wall floor floor cup        floor: 1 right, 1 missed, 1 wrong -> IoU 1/3,
    # recall
    # 1/2 the band of one pixel is columns 1 and 2: wall 0/1, floor 1/2; the teacher is right
    # everywhere
    task = Task(["floor", "wall", "cup"], np.eye(3), ["wall", "floor", "lamp"], boundary=1)
    seen = view(
        [[1, 0, 0, 2]], 3, truth=np.array([[0, 0, 1, 1]]), teacher_labels=np.array([[1, 1, 0, 0]])
    )
    found = labels.measure([seen], task)
    assert found["scene"]["miou"] == pytest.approx((1 / 2 + 1 / 3) / 2)
    assert found["scene"]["macc"] == found["scene"]["oa"] == 0.5
    assert found["scene"]["boundary_miou"] == pytest.approx((0 + 1 / 2) / 2)
    # of both that are there
    assert found["scene"]["rarest_miou"] == pytest.approx((1 / 2 + 1 / 3) / 2)
    assert found["scene"]["iou"] == {"wall": 0.5, "floor": pytest.approx(1 / 3), "lamp": None}
    assert found["teacher"]["miou"] == found["teacher"]["boundary_miou"] == 1
    # a second view, wall alone and right, of unknown pixels: sums are taken first, so wall is 3/4
    # and floor 1/3
    more = view([[1, 1, 0, 0]], 3, truth=np.array([[0, 0, -1, -1]]))
    assert replica_gt.measure([seen, more], task)["scene"]["miou"] == pytest.approx(
        (3 / 4 + 1 / 3) / 2
    )


def test_the_rarest_classes_are_those_of_fewest_pixels():
    np.testing.assert_array_equal(
        labels.rarest(np.array([9, 0, 3, 8, 1, 7, 3, 100])), [4, 2, 6, 5, 3]
    )
    assert len(labels.rarest(np.zeros(4))) == 0


def test_where_nothing_is_known_nothing_is_measured():
    task = Task(["wall"], np.eye(1), ["wall"])
    found = labels.measure([view([[0, 0]], 1, truth=np.array([[-1, -1]]))], task)["scene"]
    assert found == dict.fromkeys(
        ("miou", "macc", "oa", "boundary_miou", "rarest_miou", "point_miou")
    ) | {"iou": {"wall": None}}


@pytest.mark.parametrize(("seed", "n_classes", "n_views"), [(0, 4, 3), (1, 13, 5), (2, 40, 2)])
def test_miou_macc_and_oa_are_those_of_sets_of_pixels(seed, n_classes, n_views):
    """Oracle: each class as the set of its pixels in all views, as scikit-learn's macro averages
    are defined.
    """
    rng = np.random.default_rng(seed)
    classes = [f"class {k}" for k in range(n_classes)]
    names = [*(f"Class_{k}" for k in rng.permutation(n_classes)[:-1]), "no class of the truth"]
    # some classes are only predicted
    truths = rng.integers(-1, max(n_classes - 2, 2), (n_views, 17, 23))
    own = np.array([*(classes.index(name.lower().replace("_", " ")) for name in names[:-1]), -1])
    taken = rng.integers(0, n_classes, truths.shape)
    right = np.argsort(own)[np.maximum(truths, 0) + 1]
    taken = np.where((rng.random(truths.shape) < 0.6) & np.isin(truths, own), right, taken)
    seen = [view(ids, n_classes, truth=truth) for ids, truth in zip(taken, truths, strict=True)]
    found = labels.measure(seen, Task(names, np.eye(n_classes), classes))
    known = truths >= 0
    truth, labelled = truths[known], own[taken[known]]
    sets = [
        (set(np.flatnonzero(truth == k)), set(np.flatnonzero(labelled == k)))
        for k in range(n_classes)
    ]
    assert found["scene"]["miou"] == pytest.approx(
        np.mean([len(a & b) / len(a | b) for a, b in sets if a | b])
    )
    assert found["scene"]["macc"] == pytest.approx(
        np.mean([len(a & b) / len(a) for a, b in sets if a])
    )
    assert found["scene"]["oa"] == pytest.approx(sum(len(a & b) for a, b in sets) / known.sum())
    assert found["counted"]["miou"] == {
        "classes": sum(bool(a) for a, _ in sets),
        "pixels": known.sum(),
    }


@pytest.mark.parametrize("protocol", [labels, replica_f3, scannet_closed, scannet_open])
def test_one_class_alone_has_no_miou_and_every_miou_says_what_it_rests_on(protocol):
    names = {replica_f3: ADE, labels: ["wall", "floor"]}.get(protocol) or list(protocol.CLASSES)
    task, n = Task(names, np.eye(len(names), dtype=np.float32), names), len(names)
    for ids, classes in (([[0, 0], [0, 0]], 1), ([[0, 1], [0, 1]], 2)):
        truth, teacher = (
            (np.array(ids), one_hot(ids, n)) if protocol is replica_f3 else (np.array(ids), None)
        )
        found = protocol.measure([view(ids, n, truth=truth, teacher=teacher)], task)
        pixels = {
            labels: 4,
            replica_f3: HEIGHT * WIDTH,
            scannet_closed: 512**2,
            scannet_open: 484 * 648,
        }[protocol]
        assert found["counted"]["miou"] == {"classes": classes, "pixels": pixels}
        assert found["scene"]["miou"] == (None if classes == 1 else 1)


@pytest.mark.parametrize("wall", ["WALL", " Wall "])
@pytest.mark.parametrize(
    "screen", ["TV_Screen", "tv-screen", "tv  screen", "\ttv screen\n", "TVScreen"]
)
def test_a_name_is_the_same_however_it_is_spelt_on_either_side(wall, screen):
    truth, seen = np.array([[0, 0, 1, 1]]), [[0, 1, 1, 1]]
    for names, classes in (
        (["wall", "tv screen"], [wall, screen]),
        ([wall, screen], ["wall", "tv screen"]),
    ):
        found = labels.measure([view(seen, 2, truth=truth)], Task(names, np.eye(2), classes))[
            "scene"
        ]
        assert found["miou"] == pytest.approx((1 / 2 + 2 / 3) / 2)
    fields = {"class_names": [wall, screen], "labels": np.array([[[0, 1, -1]]], np.int16)}
    assert renamed(fields, {"things": ["tv screen"]})["labels"].tolist() == [[[-1, 0, -1]]]


def test_points_on_paper():
    # One pixel a point: three of the five lie apart, two share a cell, of which the first counts;
    # one is unknown. truth    wall wall floor (floor) ?    the scene there: wall, nothing, floor
    # wall 1/2, floor
    # 1/1: mean 3/4 teacher  wall floor floor (wall) ?
    # wall 1/2, floor
    # 1/2: mean 1/2
    places = np.array([[[0.0, 0, 0], [50, 0, 0], [100, 0, 0], [100, 1e-3, 0], [7, 0, 0]]])
    truth = np.array([[0, 0, 1, 1, -1]])

    def at(points):
        assert points.tolist() == places[0, :3].tolist()
        return one_hot([1, 0, 0], 2), np.array([0.5, 0, 0.1])

    task = Task(["floor", "wall"], np.eye(2), ["wall", "floor"], at=at)
    fields = {"truth": truth, "teacher_labels": np.array([[1, 0, 0, 1, 1]]), "surface": places}
    found = labels.measure([view([[1, 1, 0, 0, 0]], 2, **fields)], task)
    assert (found["scene"]["point_miou"], found["teacher"]["point_miou"]) == (3 / 4, 1 / 2)
    fields["surface"] = None
    found = labels.measure([view([[1, 1, 0, 0, 0]], 2, **fields)], task)
    assert found["scene"]["point_miou"] is found["teacher"]["point_miou"] is None


# replica-f3, deep-blending


def thirds(*ids):
    """Ids from 1 of three equal strips of the final image, as indices."""
    return np.repeat(np.array(ids) - 1, WIDTH // 3)[None].repeat(HEIGHT, 0)


@pytest.mark.parametrize("protocol", [replica_f3, deep_blending])
def test_agreement_with_the_teacher_on_paper(protocol):
    # teacher  wall | rug -> floor | television -> door      wall 1/1; floor 1 of 2 strips: 1/2;
    # door 0/1 student  wall | floor        | floor                   mean 1/2; 2 of 3 strips agree
    # the other image agrees, after pillow -> cushion: 1 and 1. Means over images: 3/4 and 5/6; over
    # all pixels together, floor would be 1/2, wall and cushion 1, door 0: 5/8
    task = Task(ADE, np.eye(150, dtype=np.float32))
    a = view(thirds(1, 4, 4), 150, name="a", teacher=one_hot(thirds(1, 29, 90), 150))
    b = view(thirds(58, 1, 1), 150, name="b", teacher=one_hot(thirds(40, 1, 1), 150))
    found = protocol.measure([a, b], task)["scene"]
    assert (found["miou"], found["oa"]) == (pytest.approx(3 / 4), pytest.approx(5 / 6))
    assert (found["iou"]["floor"], found["iou"]["door"], found["iou"]["cushion"]) == (0.5, 0, 1)
    assert found["iou"]["rug"] is None and found["iou"]["television"] is None


def test_only_the_seven_most_frequent_labels_of_both_images_count():
    # labels 1 to 7 twice in each image and right; label 8 once in each image, never in the same
    # place
    teacher = np.array([*np.repeat(np.arange(1, 8), 2), 8, 1])
    student = np.array([*np.repeat(np.arange(1, 8), 2), 1, 8])
    found = replica_f3.frequent_ious(student, teacher)
    assert list(found) == [1, 2, 3, 4, 5, 6, 7]  # 1 six times, the others four times, 8 twice
    assert found[1] == pytest.approx(2 / 4)
    assert set(itertools.islice(found.values(), 1, None)) == {1}


@pytest.mark.slow
def test_wide_views_are_resized_as_the_peers_do():
    """Oracle: their own calls of torch."""
    rng = np.random.default_rng(3)
    student, teacher = (
        rng.random((40, 500, 150), np.float32),
        rng.random((20, 250, 150), np.float32),
    )
    ids = []
    for features in (student, teacher):
        planes = torch.from_numpy(features).permute(2, 0, 1)[None]
        wide = torch.nn.functional.interpolate(
            planes, (360, 480), mode="bilinear", align_corners=True
        )
        found = (wide / wide.norm(dim=1, keepdim=True)).argmax(1)[0] + 1
        for old, new in ((90, 15), (29, 4), (58, 40)):
            found[found == old] = new
        ids.append(
            torch.nn.functional.interpolate(found[None, None].float(), (119, 159), mode="nearest")[
                0, 0
            ].numpy()
        )
    task = Task(ADE, np.eye(150, dtype=np.float32))
    seen = EvaluatedView("a", student, np.zeros((40, 500), np.int16), teacher)
    found = replica_f3.measure([seen], task)["scene"]
    # rounding of a few ties
    assert found["oa"] == pytest.approx(np.mean(ids[0] == ids[1]), abs=2e-4)
    assert found["miou"] == pytest.approx(
        np.mean(list(replica_f3.frequent_ious(*ids).values())), abs=1e-3
    )


def test_a_teacher_of_other_labels_cannot_be_measured_as_replica_f3():
    seen = view([[0]], 150, teacher=one_hot([[0]], 150))
    for names in (ADE[:149], [*ADE[1:], "wall"]):
        with pytest.raises(DataFailure, match="150 labels of ADE20K"):
            replica_f3.measure([seen], Task(names, np.eye(len(names), 150, dtype=np.float32)))
    with pytest.raises(DataFailure, match="no features of a teacher"):
        replica_f3.measure([view([[0]], 150)], Task(ADE, np.eye(150, dtype=np.float32)))


# scannet-open


OPEN = ["other", *reversed(scannet_open.CLASSES)]


def open_view(names, second, truth, classes):
    """Pixels whose largest cosine is `names`, next largest `second`."""
    features = sum(
        share * one_hot([[OPEN.index(name) for name in row] for row in rows], 21)
        for share, rows in ((1.0, names), (0.5, second))
    )
    ids = [[classes.index(name) if name else -1 for name in row] for row in truth]
    return EvaluatedView(
        "a", features, features.argmax(-1).astype(np.int16), truth=np.array(ids, np.int16)
    )


@pytest.mark.parametrize("classes", [scannet_open.CLASSES, scannet_closed.CLASSES])
def test_scannet_open_on_paper_whatever_the_ids_of_the_truth(classes):
    # truth      wall                shelves | nothing  counter    wall 1/1; shelves 0/1; counter 1
    # right, 1 wrong: 1/2 predicted  other, else wall    counter | bag      counter    mean 1/2;
    # recall 1, 0, 1; bag is not in the truth
    # With the two swapped ids (shelves, counter) confused, shelves would be 1/2, counter 0 and
    # recall 1, 1, 0.
    names, second = [["other", "counter"], ["bag", "counter"]], [["wall", "bag"], ["wall", "bag"]]
    seen = open_view(names, second, [["wall", "shelves"], [None, "counter"]], classes)
    found = scannet_open.measure([seen], Task(OPEN, np.eye(21, dtype=np.float32), list(classes)))[
        "scene"
    ]
    assert found["miou"] == pytest.approx(1 / 2)
    assert found["macc"] == found["oa"] == pytest.approx(2 / 3)
    assert (found["iou"]["shelves"], found["iou"]["counter"], found["iou"]["bag"]) == (0, 0.5, None)
    block = 484 * 648 // 4
    assert (
        found["confusion"][9][10] == found["confusion"][10][10] == found["confusion"][0][0] == block
    )


@pytest.mark.parametrize("change", [lambda n: n[:-1], lambda n: [*n, "cup"]])
@pytest.mark.parametrize("protocol", [scannet_open, scannet_closed])
def test_scannet_takes_its_own_classes_and_no_others(protocol, change):
    names = change(list(protocol.CLASSES))
    with pytest.raises(DataFailure, match=f"{protocol.NAME} (asks for its|knows no cup)"):
        protocol.measure([], Task(names, np.eye(len(names)), list(protocol.CLASSES)))


# scannet-closed


def closed_matrix(**counts):
    """Counts of truth_prediction in 1000 pixels."""
    names, matrix = [scannet_closed.VOID, *scannet_closed.CLASSES], np.zeros((22, 22), int)
    for pair, count in counts.items():
        truth, found = pair.split("_")
        matrix[names.index(truth), names.index(found)] = count
    assert matrix.sum() == 1000
    return matrix


def test_scannet_closed_on_paper():
    # wall 900 of 906 right (4 void, 2 lamp) and none wrong: 900/906; floor 80 of 88 right, 4 bag, 4
    # counter: 80/88 counter: true 2, predicted 6: 0.6 % is kept, 2/6 right; void 0.4 %, bag 0.4 %
    # and lamp 0.2 +
    # 0.2 % are dropped, although lamp has 0.4 % in both together
    matrix = closed_matrix(wall_wall=900, wall_void=4, wall_lamp=2, floor_floor=80, floor_bag=4,
                           floor_counter=4,
                           counter_counter=2, lamp_wall=0, lamp_lamp=2, bed_bed=2)  # fmt: skip
    found = scannet_closed.figures(matrix)
    assert found["miou"] == pytest.approx((900 / 906 + 80 / 88 + 2 / 6) / 3)
    assert [name for name, value in found["iou"].items() if value is not None] == [
        "wall",
        "floor",
        "counter",
    ]
    # one more pixel predicted void: 0.5 % is not under 0.5 %, and void counts with IoU 0
    matrix = closed_matrix(wall_wall=899, wall_void=5, wall_lamp=2, floor_floor=80, floor_bag=4,
                           floor_counter=4,
                           counter_counter=2, lamp_lamp=2, bed_bed=2)  # fmt: skip
    found = scannet_closed.figures(matrix)
    assert found["iou"]["void"] == 0
    assert found["miou"] == pytest.approx((0 + 899 / 906 + 80 / 88 + 2 / 6) / 4)


@pytest.mark.parametrize(
    "classes", [scannet_open.CLASSES, scannet_closed.CLASSES, ("void", *scannet_closed.CLASSES)]
)
def test_scannet_closed_masks_void_joins_names_and_ignores_the_aspect(classes):
    # truth     counter shelves wall   void      counter 1/2 (one pixel right, one shelves taken for
    # it) predicted counter counter wall   shelves   shelves 0/1; wall 1; the last pixel does not
    # count: mean 1/2
    names = list(reversed(scannet_closed.CLASSES))
    predicted = np.array(
        [[names.index(name) for name in ("counter", "counter", "wall", "shelves")]]
    )
    nothing = classes.index("void") if "void" in classes else -1
    truth = np.array([[*(classes.index(name) for name in ("counter", "shelves", "wall")), nothing]])
    task = Task(names, np.eye(21), list(classes))
    found = scannet_closed.measure([view(predicted, 21, truth=truth)], task)["scene"]
    assert found["miou"] == pytest.approx((1 / 2 + 0 + 1) / 3)
    assert (found["iou"]["counter"], found["iou"]["shelves"], found["iou"]["wall"]) == (0.5, 0, 1)


def test_scannet_closeds_scenes_weigh_alike():
    assert scannet_closed.averaged([0.5, 1.0, None]) == 0.75
    assert scannet_closed.averaged([None]) is None


# what they share


def test_views_are_joined_on_names():
    rows = MapsByName(["b", "a"], np.array([[2], [1]]), "labels")
    assert [rows[name][0] for name in ("a", "b")] == [1, 2]
    with pytest.raises(DataFailure, match="view c has no labels"):
        rows["c"]


@pytest.mark.parametrize("size", [(119, 159), (7, 31), (360, 480)])
def test_nearest_pixels_are_those_of_torch_and_pil(size):
    ids = np.random.default_rng(0).integers(0, 150, (97, 211)).astype(np.uint8)
    theirs = torch.nn.functional.interpolate(
        torch.from_numpy(ids)[None, None], size, mode="nearest"
    )[0, 0]
    assert (resized(ids, size) == theirs.numpy()).mean() > 0.999  # torch counts in float32
    pil = np.asarray(Image.fromarray(ids).resize(size[::-1], Image.Resampling.NEAREST))
    assert (resized(ids, size, centred=True) == pil).mean() > 0.999


def test_bilinear_resizing_equals_torch_with_aligned_corners():
    features = np.random.default_rng(0).random((9, 14, 3), np.float32)
    for size in ((36, 48), (5, 4), (9, 14), (1, 1)):
        theirs = torch.nn.functional.interpolate(
            torch.from_numpy(features).permute(2, 0, 1)[None],
            size,
            mode="bilinear",
            align_corners=True,
        )
        assert np.abs(bilinear(features, size) - theirs[0].permute(1, 2, 0).numpy()).max() < 1e-6


def test_few_training_views_are_chosen_evenly_and_all_test_views_stay():
    names = [f"{k:02}" for k in range(20)]
    is_test = np.arange(20) % 8 == 2
    images = np.arange(20, dtype=np.uint8)[:, None, None, None] * np.ones((20, 2, 2, 3), np.uint8)
    fields = {
        "names": names,
        "images": images,
        "Ks": np.zeros((20, 3, 3)),
        "cam_from_world": None,
        "is_test": is_test,
    }
    kept = thinned(fields, 4)
    assert kept["names"] == ["00", "02", "06", "10", "13", "18", "19"]
    assert [f"{row[0, 0, 0]:02}" for row in kept["images"]] == kept["names"]
    assert kept["is_test"].tolist() == [name in ("02", "10", "18") for name in kept["names"]]
    assert thinned(fields, 17) == thinned(fields, None) == {}


def test_a_source_s_classes_are_renamed_and_merged():
    fields = {
        "labels": np.array([[[0, 1, 2, -1]]], np.int16),
        "class_names": ["RoomWall", "HouseWall", "Cup"],
    }
    found = renamed(fields, {"table": [], "wall": ["HouseWall", "RoomWall"]})
    assert found["class_names"] == ["table", "wall"]
    assert found["labels"].tolist() == [[[1, 1, -1, -1]]]
    with pytest.raises(ConfigError, match="no class Sofa; it has RoomWall"):
        renamed(fields, {"sofa": ["Sofa"]})
    with pytest.raises(ConfigError, match="has none"):
        renamed({"labels": None, "class_names": None}, {"wall": []})
