"""Knowledge that a scene started from, and its lesson for later scenes, for the report's page."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from chebsplat.formats.knowledge import read_card


class Started(NamedTuple):
    """rows: (name, value in words); lessons: (scene, trust, reason, new in kind), by trust."""

    rows: list[tuple[str, str]]
    lessons: list[tuple[str, str, str, str]]


def started(inputs: dict[str, Path], facts: dict[str, dict[str, Any]]) -> Started | None:
    """The knowledge of a scene in words; None where it has none, or could not use it.

    Args: inputs: of the report; facts: of their manifests; both by role.
    """
    refined = facts.get("refined", {"knowledge": {}})
    if "knowledge" not in inputs or "knowledge" not in refined:
        return None
    document = read_card(inputs["knowledge"])
    card, solved = document["card"], document["lessons"]
    encoder = (
        f"taught over {card['n_rooms']} generated rooms"
        if "n_rooms" in card
        else document["teacher"]
    )
    rows = [("the encoder of shape", encoder)]
    of = solved.get("of", [])
    used = sum(lesson["trust"] > 0 for lesson in of)
    count = f"{used} of {len(of)} are trusted" if of else "none: what ships, and nothing else"
    rows.append(("lessons of other scenes", count))
    rows += worth(refined) + left_behind(facts.get("learned", {}))
    lessons = [
        (lesson["scene"], f"{lesson['trust']:.2f}", lesson["why"], "yes" if lesson["new"] else "no")
        for lesson in sorted(of, key=lambda lesson: -lesson["trust"])
    ]
    return Started(rows, lessons)


def worth(refined: dict[str, Any]) -> list[tuple[str, str]]:
    """Labels of half the views that the other half reproduces, without knowledge and with it."""
    if "believed" not in refined:
        return []
    if "halves" not in refined:
        return [
            (
                "labels of half the training views that the other half reproduces",
                "not told: it counts for nothing here",
            )
        ]
    without, with_it = refined["halves"]["without"], refined["halves"]["with"]
    belief = refined["believed"]
    views = f"{without:.1%} without it, {with_it:.1%} with it"
    views += f", counting as {refined['strength']:.2g} views"
    if belief < 1:
        views += f", of which {belief:.0%} is believed: the teacher says otherwise"
    return [("labels of half the training views that the other half reproduces", views)]


def left_behind(lesson: dict[str, Any]) -> list[tuple[str, str]]:
    """The scene's own lesson: novelty, size, and the evidence by which later scenes trust it."""
    if "rho" not in lesson:
        return []
    figures = f"ρ {lesson['rho']:.3f}, σ_f {lesson['sigma']:.3f}, ρ′ {lesson['novelty']:.3f}"
    new = "new in kind" if lesson["novelty"] > lesson["known"] else "of a known kind"
    figures += f": {new}; what is known stays below {lesson['known']:.3f}"
    added = f"{lesson['n_points']:,} points, {lesson['n_labels']} labels"
    if lesson["unnamed"]:
        added += f"; without a word, and so not learned: {', '.join(lesson['unnamed'])}"
    alike = (
        f"shape has {lesson['alike']:.0%} of its labels alike, and is "
        f"{lesson['familiar']:.2f} as sure"
    )
    return [
        ("novelty of this scene (Eq 15)", figures),
        ("what this scene adds", added),
        (
            "by which later scenes trust it",
            f"its labels were given; {alike}" if lesson["given"] else alike,
        ),
    ]
