"""recall: the knowledge that a scene starts from: the shipped encoder, and a map of all lessons."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.knowledge import Knowledge, read_knowledge, write_knowledge
from chebsplat.formats.lesson import Lesson, read_lesson
from chebsplat.shape.lessons import Sums, basis, combined, mapped, mean_of, unexplained
from chebsplat.stages.registry import LESSON
from chebsplat.stages.runtime.command import Job

# share of labels that shape and teacher have alike: below it no trust, above it all
ALIKE = 0.5, 0.75
# the same of labels that the user vouches for: below it they are as good as random
GIVEN = 0.1, 0.2
FAMILIAR = 0.4  # the same of how sure the teacher is beside shape (`blend.familiar`), from 0 up


def run(job: Job) -> None:
    """The map of a scene's pinned lessons, each weighted by its trust (docs/method.md, section 14).

    Reads the `knowledge` that ships, and of each such scene its `lesson`. Writes `knowledge`.
    """
    start = read_knowledge(job.inputs["start"])
    paths = {
        role.removeprefix(LESSON): path
        for role, path in job.inputs.items()
        if role.startswith(LESSON)
    }
    lessons = {key: read_lesson(path) for key, path in sorted(paths.items())}
    for key, lesson in lessons.items():
        if lesson.sums[0].shape != (len(start.map),) * 2:
            raise InputError(
                f"{paths[key]} is a lesson of another encoder; learn it again (`chebsplat "
                "knowledge rebuild`)"
            )
    knowledge = combine_lessons(start, lessons)
    sums = mean_of([Sums(*of) for of in (*start.shipped, *(one.sums for one in lessons.values()))])
    job.facts["unexplained"] = unexplained(sums, knowledge.map.astype(np.float64))
    job.facts |= knowledge.lessons | {
        "n_lessons": len(lessons),
        "encoder": read_manifest(job.inputs["start"]).key,
    }
    write_knowledge(job.out, knowledge)


def combine_lessons(start: Knowledge, lessons: Mapping[str, Lesson]) -> Knowledge:
    """Knowledge solved from the shipped sums and those of lessons, in the order of their keys.

    Choices: the basis grows by lessons that are trusted, and newer in kind than any shipped room.
    """
    shipped = [Sums(*of) for of in start.shipped]
    used = {key: of for key, of in sorted(lessons.items()) if "none" not in of.notes}
    sums = [Sums(*of.sums) for of in used.values()]
    trust = [trusted(of.notes) for of in used.values()]
    new = [of.notes["novelty"] > of.notes["known"] for of in used.values()]
    growing = [k for k, weight in enumerate(trust) if new[k] and weight > 0]
    growth = combined(
        [mean_of(shipped), *(sums[k] for k in growing)],
        [1.0, *(trust[k] for k in growing)],
    )
    return dataclasses.replace(
        start,
        map=mapped(shipped, sums, trust).astype(np.float32),
        basis=basis(growth, start.scale).astype(np.float32),
        shipped=[],
        lessons={
            "of": [
                {
                    "key": key,
                    "scene": of.notes["scene"],
                    "trust": weight,
                    "why": why(of.notes),
                    "new": novel,
                }
                for (key, of), weight, novel in zip(used.items(), trust, new, strict=True)
            ]
        },
    )


def trusted(notes: Mapping[str, Any]) -> float:
    """Trust in a lesson, in [0, 1].

    Choices: by the share of labels that shape and teacher agree on, and by how sure the teacher is
      beside shape: a teacher out of its depth gives the same wrong label in every view, which no
      agreement of views reveals. 1 where the user answers for the labels, unless shape agrees with
      next to none of them.
    """
    least, enough = GIVEN if notes["given"] else ALIKE
    alike = float(np.clip((notes["alike"] - least) / (enough - least), 0, 1))
    return alike if notes["given"] else alike * float(np.clip(notes["familiar"] / FAMILIAR, 0, 1))


def why(notes: Mapping[str, Any]) -> str:
    """Reason of a lesson's trust, in words."""
    if notes["given"]:
        return f"its labels were given, and shape has {notes['alike']:.0%} of them alike"
    return (
        f"shape has {notes['alike']:.0%} of its labels alike, and is {notes['familiar']:.2f} "
        "as sure"
    )
