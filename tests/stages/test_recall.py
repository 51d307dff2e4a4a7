"""What lessons are trusted, and the knowledge that they make: in any order, and as if the forgotten
had never been.
"""

import numpy as np
import pytest

from chebsplat.formats.knowledge import Knowledge
from chebsplat.formats.lesson import Lesson
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.blend import familiar
from chebsplat.shape.lessons import scale_of, summed
from chebsplat.stages.recall import combine_lessons, trusted, why

P, L = 8, 6  # features, labels
MAP = np.random.default_rng(1).normal(size=(P, L))


def scene(seed, n=400, permuted=False, length=1.0):
    """A lesson as the stage `learn` makes it: shape tells labels, and the teacher's views say
    these, or others.
    """
    rng = np.random.default_rng(seed)
    labels, codes = rng.integers(0, L, n), np.eye(L)
    z = codes[labels] @ np.linalg.pinv(MAP) + 0.05 * rng.normal(size=(n, P))
    z[:, -1] = 1
    said = rng.permutation(labels) if permuted else labels
    meanings = (length * codes[said] + 0.05 * rng.normal(size=(n, L))).astype(np.float32)
    answers = (codes[labels] + 0.05 * rng.normal(size=(n, L))).astype(np.float32)
    sums = summed(z, meanings, np.ones(n))
    alike = float((decode_labels(answers, codes) == decode_labels(meanings, codes)).mean())
    notes = {
        "scene": f"s{seed}",
        "given": False,
        "alike": alike,
        "novelty": 0.1 * (seed % 4),
        "known": 0.15,
    }
    return Lesson(
        (sums.gram, sums.cross, sums.square),
        notes | {"familiar": familiar(meanings, answers, codes)},
    )


@pytest.fixture(scope="module")
def start():
    shipped = [scene(k).sums for k in (100, 101)]
    whole = summed(np.eye(P), np.zeros((P, L)), np.ones(P))
    of = {
        "teacher": "t",
        "digest": "d",
        "encoder": {},
        "weights": {},
        "matrix": np.eye(L),
        "describe": {},
    }
    of |= {
        "words": [],
        "embeddings": np.eye(L),
        "map": MAP,
        "basis": np.eye(P)[:, :3],
        "scale": scale_of(whole),
    }
    return Knowledge(**of, classes=[], class_means=np.zeros((0, P)), card={}, shipped=shipped)


def test_a_lesson_is_trusted_as_far_as_shape_and_teacher_are_of_one_mind():
    right, wrong = scene(1), scene(1, permuted=True)
    assert trusted(right.notes) > 0.9
    assert trusted(wrong.notes) <= 0.1
    given = wrong.notes | {"given": True}  # labels that the user answers for
    assert trusted(given | {"alike": 0.3}) == 1 and trusted(given | {"alike": 0.08}) == 0
    assert "given" in why(wrong.notes | {"given": True}) and f"{right.notes['alike']:.0%}" in why(
        right.notes
    )
    for alike, sure, least, most in (
        (0.52, 0.3, 0, 0.1),
        (0.9, 0.03, 0, 0.1),
        (0.625, 0.9, 0.5, 0.5),
        (1, 1, 1, 1),
    ):
        found = trusted({"given": False, "alike": alike, "familiar": sure})
        assert least <= found <= most


def test_lessons_teach_the_same_in_any_order_and_leave_nothing_when_they_are_forgotten(start):
    lessons = {f"{k:02d}": scene(k, permuted=k == 5, length=1 + 0.1 * k) for k in range(12)}
    lessons["99"] = Lesson((np.zeros((P, P)), np.zeros((P, L)), 0.0), {"none": "no surface"})
    whole = combine_lessons(start, lessons)
    assert [of["key"] for of in whole.lessons["of"]] == sorted(lessons)[:-1]
    assert [of["key"] for of in whole.lessons["of"] if of["trust"] <= 0.1] == ["05"]
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(sorted(lessons))
        again = combine_lessons(start, {key: lessons[key] for key in order})
        assert (
            again.map.tobytes() == whole.map.tobytes()
            and again.basis.tobytes() == whole.basis.tobytes()
        )
        assert again.lessons == whole.lessons
        renamed = combine_lessons(
            start, {f"{place:02d}": lessons[key] for place, key in enumerate(order)}
        )
        # float32's own
        np.testing.assert_allclose(renamed.map, whole.map, rtol=0, atol=1e-6 * abs(whole.map).max())
    never = combine_lessons(start, {key: of for key, of in lessons.items() if key != "03"})
    assert not np.array_equal(never.map, whole.map)
    lessons.pop("03")
    left = combine_lessons(start, lessons)
    assert (left.map.tobytes(), left.basis.tobytes()) == (
        never.map.tobytes(),
        never.basis.tobytes(),
    )
    assert left.lessons == never.lessons
    without_wrong = combine_lessons(start, {key: of for key, of in lessons.items() if key != "05"})
    # who is not trusted teaches nothing
    np.testing.assert_allclose(without_wrong.map, left.map, atol=1e-6)


def test_what_is_known_grows_by_trusted_lessons_of_another_kind(start):
    z = np.zeros((9, P))
    z[:, 6] = 1  # of which what ships has a part alone
    sums = summed(z, np.ones((9, L)), np.ones(9))

    def known(**notes):
        basis = combine_lessons(
            start, {"a": Lesson((sums.gram, sums.cross, sums.square), scene(3).notes | notes)}
        ).basis
        return float(basis[6] @ basis[6])

    before = combine_lessons(start, {}).basis[6] @ combine_lessons(start, {}).basis[6]
    assert before < 0.9
    assert known(novelty=0.2) > 0.95
    assert known(novelty=0.1) == known(novelty=0.2, alike=0.2) == pytest.approx(before)
