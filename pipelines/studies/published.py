"""Tables of a paper: its figures beside those of our runs, or the reason why there are none."""

from __future__ import annotations

from chebsplat.evaluation import protocols
from chebsplat.pipelines.studies.results import FIGURES, Figure, Line, Row, compare
from chebsplat.pipelines.studies.study import Study, list_missing
from chebsplat.pipelines.studies.tables import Section, mean_text
from chebsplat.stages.runtime.config import build


def published_sections(study: Study, rows: list[Row]) -> list[Section]:
    """A section for each of a study's tables: a row a method of the paper and a row a variant.

    A row has the paper's and our value of each published figure, the finished runs, and why scenes
    are missing. The note gives the protocol of both.
    """
    lines = {(line.condition, line.variant): line for line in compare(rows, study.baseline)}
    sections = []
    for condition, table in study.tables.items():
        published_keys = {key for figures in table.published.values() for key in figures}
        columns = [figure for figure in FIGURES if figure.key in published_keys]
        body = [["in the paper", "here", "runs"]]
        body[0] += [
            heading for figure in columns for heading in (f"{figure.heading}: paper", "here")
        ]
        body[0] += ["not run, and why"]
        stands = {row: variant for variant, row in table.variants.items() if row}
        methods = [(row, stands.get(row, "")) for row in table.published]
        for row, variant in [
            *methods,
            *(("", name) for name, of in table.variants.items() if not of),
        ]:
            line = lines.get((condition, variant))
            reasons = list_missing(study, condition, variant) if variant else {}
            cells = [row or "-", variant or "-", f"{line.n_done} of {line.n_runs}" if line else "-"]
            for figure in columns:
                cells += _cells(table.published.get(row, {}), line, figure)
            listed = {
                why: "all" if of == table.scenes else ", ".join(of) for why, of in reasons.items()
            }
            body.append([*cells, "; ".join(f"{of}: {why}" for why, of in listed.items()) or "-"])
        finished = [row for row in rows if row["condition"] == condition and row["state"] == "done"]
        sections.append(Section(condition, _note(study, condition, finished), body))
    return sections


def _cells(paper: dict[str, float], line: Line | None, figure: Figure) -> list[str]:
    """A figure of the paper, and ours."""
    theirs = f"{paper[figure.key]:.{figure.digits}f}" if figure.key in paper else "-"
    own = line.summaries.get(figure.key) if line else None
    return [theirs, mean_text(own, figure) if own else "-"]


def _note(study: Study, condition: str, finished: list[Row]) -> str:
    """The protocol of a table as configured, and the resolution and split of its finished runs."""
    ingest = build(study.conditions[condition], condition).ingest
    rule = protocols.load(ingest.protocol).RULE
    split = f"view index % {rule.test_every} == {rule.test_offset} is test"
    if rule.on_training:
        split = "no view is held out"
    elif rule.own_split:
        split += " unless the source says"
    views = f", {ingest.max_views} views a scene" if ingest.max_views else ""
    text = f"Protocol {ingest.protocol}: {split}, {ingest.max_side} pixels at most{views}; scenes "
    text += f"{', '.join(study.tables[condition].scenes)}."
    used = sorted({f"{row['resolution']} ({row['split']})" for row in finished})
    return text + (f" Measured at {'; '.join(used)}." if used else "")
