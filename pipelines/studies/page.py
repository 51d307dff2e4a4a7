"""The results of a study as files: results.csv, results.md, the picture, a self-contained page."""

from __future__ import annotations

import base64
import csv
import html
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from chebsplat.errors import DataFailure
from chebsplat.evaluation import protocols
from chebsplat.formats import artifact
from chebsplat.formats.manifest import measured_on
from chebsplat.pipelines.studies import figures
from chebsplat.pipelines.studies.pictures import gallery
from chebsplat.pipelines.studies.results import COLUMNS, Row, compare, on_one_machine, traces
from chebsplat.pipelines.studies.study import Run, Study
from chebsplat.pipelines.studies.tables import (
    Section,
    labels,
    left_out,
    missing,
    scene_table,
    shown_figures,
    table_row,
    tables,
)
from chebsplat.stages.pages.parts import rendered
from chebsplat.stages.report import LARGEST

PAGE = Path(__file__).with_name("page.html")  # a jinja2 template without external resources
NAME = "study.html"
PICTURE = "error-against-time.png"
# Markdown's special characters
MARKUP = re.compile(r"([\\`*_{}\[\]|~$^#])|^(\d*)([-+=.)])(?=[\s=-]|$)")
NARROW = 1100  # pixels of a screen that is narrower than the comparison's tables


def write(
    out: Path,
    study: Study,
    runs: list[Run],
    rows: list[Row],
    command: str,
    more: Sequence[Section] = (),
) -> Path:
    """Fill `out`; returns the page. Failed and missing runs are named, and in no mean.

    Args: more: further sections.
    """
    out.mkdir(parents=True, exist_ok=True)
    with (out / "results.csv").open("w", newline="") as handle:
        writer = csv.DictWriter(handle, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    named = facts(runs, rows, command)
    rows, elsewhere = on_one_machine(rows)
    named += [("beware", words) for words in elsewhere]
    settings = settings_of(study) if study.against else None
    figures.draw(out / PICTURE, rows, traces(runs, rows), settings, study.against)
    lines = compare(rows, study.baseline)
    parts = {
        "study": study,
        "facts": named,
        "labels": labels(lines),
        "header": [*labels(lines), "runs", *(figure.heading for figure in shown_figures(lines))],
        "table": [(line.variant == study.baseline, table_row(line, lines)) for line in lines],
        "tables": tables(lines, study.baseline),
        "scenes": scene_table(rows),
        "missing": missing(rows),
        "note": note(study, rows),
        "more": more,
        "left_out": left_out(rows),
    }
    (out / "results.md").write_text(markdown(parts))

    drawing = base64.b64encode((out / PICTURE).read_bytes()).decode()
    page = rendered(
        PAGE,
        narrow=NARROW,
        picture=f"data:image/png;base64,{drawing}",
        **parts,
        **gallery(study, runs, rows),
    )
    if len(page) > LARGEST:
        raise DataFailure(
            f"the page would have {len(page) / 1e6:.0f} MB; name fewer scenes or "
            "variants in the study"
        )
    (out / NAME).write_text(page)
    return out / NAME


def settings_of(study: Study) -> dict[str, float]:
    """The value of `study.against` under every condition."""
    section, key = study.against.split(".")
    return {name: float(values[section][key]) for name, values in study.conditions.items()}


def note(study: Study, rows: list[Row]) -> str:
    """The caption of the comparison's table."""
    n_scenes = len({row["scene"] for row in rows})
    unit = (
        f"Student's over the {n_scenes} scenes"
        if n_scenes > 1
        else ("Student's over the seeds of the one scene")
    )
    first = ""
    if any(hasattr(protocols.load(row["protocol"]), "over_scenes") for row in rows):
        first = " mIoU, mAcc and OA are of all scenes of a seed together, as the protocol has it."
    return (
        "Mean ± standard deviation over scenes and seeds, on the views of the protocol. Below "
        "it: the mean difference "
        f"(× ratio) from {study.baseline} of runs with the same scene, seed, condition and "
        "budget, with its "
        f"95 % interval ({unit}); bold where the interval excludes no effect.{first}"
    )  # fmt: skip


def facts(runs: list[Run], rows: list[Row], command: str) -> list[tuple[str, str]]:
    """Provenance of the figures: command, protocol, machines, versions, commit."""
    finished = [(run, row) for run, row in zip(runs, rows, strict=True) if row["state"] == "done"]
    manifests = [artifact.read_manifest(run.plan.targets["train"]) for run, _ in finished]
    loads = [value for m in manifests for process in m.processes for value in process["load"]]
    versions = {f"{k} {v}" for m in manifests for k, v in m.versions.items()}
    commits = {
        m.code["commit"][:10] + (" with changes" if m.code.get("dirty") else "")
        for m in manifests
        if "commit" in m.code
    }
    return [
        ("command", command),
        ("protocol", ", ".join(sorted({row["protocol"] for row in rows}))),
        (
            "runs",
            f"{len(finished)} of {len(rows)} done; {len({m.key for m in manifests})} different "
            "trainings",
        ),
        ("device", ", ".join(sorted({m.device for m in manifests}))),
        ("measured on", "; ".join(sorted({measured_on(m) for m in manifests}))),
        ("load of the machine", f"{min(loads):g} to {max(loads):g}" if loads else "not recorded"),
        ("versions", ", ".join(sorted(versions))),
        ("commit", ", ".join(sorted(commits)) or "not in a checkout"),
    ]


def inert(text: str) -> str:
    """Text that Markdown, and the HTML in it, shows as it is, in one line."""
    return MARKUP.sub(r"\2\\\1\3", html.escape(" ".join(text.split()), quote=False))


def markdown(parts: dict[str, Any]) -> str:
    """The study's section of docs/results/; names from outside are made `inert`."""
    study = parts["study"]
    text = [f"## {inert(study.title)}", "", inert(study.about), ""]
    text += [f"- {what}: {inert(value)}" for what, value in parts["facts"]]
    text += ["", f"![error against run time]({PICTURE})", "", inert(parts["note"]), ""]
    cells = [[(inert(a), b, bold) for a, b, bold in row] for _, row in parts["table"]]
    rows = [
        [f"{a}<br>{f'**{b}**' if bold else b}" if b else a for a, b, bold in row] for row in cells
    ]
    tables = [("", "", [parts["header"], *rows])]
    more = [(f"### {inert(s.heading)}", s.note, s.table) for s in parts["more"]]
    each = [("### Each scene", "", parts["scenes"])] if parts["scenes"][1:] else []
    for heading, note, table in (*more, *each):
        tables.append((heading, inert(note), [list(map(inert, row)) for row in table]))
    for heading, note, table in tables:
        text += [heading, ""] if heading else []
        text += [note, ""] if note else []
        text += ["| " + " | ".join(row) + " |" for row in table[:1]]
        text += ["|" + "---|" * len(table[0])]
        text += ["| " + " | ".join(row) + " |" for row in table[1:]] + [""]
    if parts["left_out"]:
        text += ["### Left out, and why", ""]
        text += ["- {}: {} ({})".format(*map(inert, line)) for line in parts["left_out"]] + [""]
    if parts["missing"]:
        text += [
            "### Runs without figures",
            "",
            *(f"- {inert(run)}: {inert(why)}" for run, why in parts["missing"]),
            "",
        ]
    return "\n".join(text)
