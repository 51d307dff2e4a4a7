"""The report's part about knowledge: what a scene started from, and what it leaves to others."""

import pytest
from malformed.artifacts import artifacts
from shared import KEY, run_stage

from chebsplat.formats.artifact import publish, write_document
from chebsplat.formats.manifest import Manifest

REFINED = {
    "smooth": True,
    "strength": 2.0,
    "familiar": 1.0,
    "believed": 1.0,
    "halves": {"without": 0.9012, "with": 0.9134},
    "knowledge": {"of": "depth"},
}
LESSON = {
    "given": False,
    "alike": 0.7,
    "familiar": 0.5,
    "n_points": 1234,
    "n_labels": 5,
    "unnamed": ["yoke"],
}
LESSON |= {"rho": 0.2, "sigma": 0.9, "novelty": 0.218, "known": 0.16}
SOLVED = {
    "of": [
        {"key": KEY, "scene": "attic", "trust": 1.0, "why": "its labels were given", "new": True}
    ],
}


def page_of(folder, refined=REFINED, lesson=LESSON, lessons=SOLVED, knowledge=True, stage="recall"):
    """The report of a scene whose stages found these, in one line."""
    inputs = {"evaluation": artifacts() / "evaluate", "gaussians": artifacts() / "train"}
    card = {"n_rooms": 80}
    made = {"refined": ("refined/2", "refine", refined), "learned": ("lesson/2", "learn", lesson)}
    if knowledge:
        made["knowledge"] = ("knowledge/4", stage, card)
    for role, (schema, by, facts) in made.items():
        if facts is not None:
            manifest = Manifest(f"chebsplat.{schema}", KEY, by, facts=facts, seconds=272.0)
            with publish(folder / role, manifest) as out:
                write_document(
                    out / "knowledge.json", {"teacher": "tiny", "card": card, "lessons": lessons}
                )
            inputs[role] = folder / role
    assert run_stage("report", folder / "report", inputs, {}) == 0
    return " ".join((folder / "report/report.html").read_text().split())


# the small trace has one row
pytestmark = pytest.mark.filterwarnings("ignore:No artists with labels")


def test_the_page_tells_which_lessons_a_scene_started_from_what_they_were_worth_and_what_it_adds(
    tmp_path,
):
    page = page_of(tmp_path)
    for told in (
        "What this scene started from", "taught over 80 generated rooms", "1 of 1 are trusted",
        "attic",
        "its labels were given", "90.1% without it, 91.3% with it",
        "ρ 0.200, σ_f 0.900, ρ′ 0.218: new in kind", "1,234 points, 5 labels", "not learned: yoke",
        "shape has 70% of its labels alike, and is 0.50 as sure",
    ):  # fmt: skip
        assert told in page


def test_a_scene_of_what_ships_alone_says_so_and_has_no_lesson_and_none_of_its_seconds(tmp_path):
    page = page_of(tmp_path, lesson=None, lessons={}, stage="teach")
    assert "none: what ships, and nothing else" in page
    assert "Eq 15" not in page and "lesson of" not in page
    assert "recall" not in page and "<b>272.0</b>" in page  # of refine


@pytest.mark.parametrize("knowledge", [False, True])
def test_a_scene_without_knowledge_or_that_could_not_use_it_shows_nothing(tmp_path, knowledge):
    unused = {name: value for name, value in REFINED.items() if name != "knowledge"}
    assert "started from" not in page_of(tmp_path, refined=unused, lesson=None, knowledge=knowledge)
