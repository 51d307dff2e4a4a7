"""What a study leaves behind: results.csv, results.md, the picture, and one self-contained page."""

from __future__ import annotations

import base64
import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import DataFailure
from chebsplat.evaluation import protocols
from chebsplat.evaluation.statistics import Difference, Summary, summarize
from chebsplat.formats import artifact
from chebsplat.pipelines import study_figures
from chebsplat.pipelines.results import COLUMNS, FIGURES, Figure, Line, Row, compare, counted, groups, traces
from chebsplat.pipelines.study import Run, Study

if TYPE_CHECKING:
    from chebsplat.pipelines.transfer import Section

PICTURE = "error-against-time.png"
STABILITY = Path("build/bench/stability.csv")  # of `make stability`
BY_SCENE = ("miou", "miou_gain", "psnr", "n_gaussians", "train_seconds")


def write(
    out: Path, study: Study, runs: list[Run], rows: list[Row], command: str, more: Sequence[Section] = ()
) -> Path:
    """Fill `out`; returns the page. Runs that failed or have not run are named, and count in no mean.

    Args: more: further sections, whose pictures lie in `out` already.
    """
    out.mkdir(parents=True, exist_ok=True)
    with (out / "results.csv").open("w", newline="") as handle:
        writer = csv.DictWriter(handle, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    settings = settings_of(study) if study.against else None
    study_figures.draw(out / PICTURE, rows, traces(runs, rows), settings, study.against)
    lines = compare(rows, study.baseline)
    parts = {
        "study": study,
        "facts": facts(runs, rows, command),
        "labels": labels(lines),
        "header": [*labels(lines), "runs", *(figure.heading for figure in shown_figures(lines))],
        "table": [(line.variant == study.baseline, table_row(line, lines)) for line in lines],
        "scenes": scene_table(rows),
        "missing": missing(rows),
        "note": note(study, rows),
        "stability": stability(STABILITY),
        "more": more,
        "left_out": left_out(rows),
    }
    (out / "results.md").write_text(markdown(parts))
    from chebsplat.pipelines.study_pictures import gallery
    from chebsplat.pipelines.study_template import PAGE
    from chebsplat.stages.report import LARGEST
    from chebsplat.stages.viewer import rendered

    drawings = {
        name: "data:image/png;base64," + base64.b64encode((out / name).read_bytes()).decode()
        for name in (PICTURE, *(section.picture for section in more if section.picture))
    }
    page = rendered(PAGE, picture=drawings[PICTURE], drawings=drawings, **parts, **gallery(study, runs, rows))
    if len(page) > LARGEST:
        raise DataFailure(f"the page would have {len(page) / 1e6:.0f} MB; name fewer scenes or variants in the study")
    (out / "study.html").write_text(page)
    return out / "study.html"


def settings_of(study: Study) -> dict[str, float]:
    """The value of `study.against` under every condition."""
    section, key = study.against.split(".")
    return {name: float(values[section][key]) for name, values in study.conditions.items()}


def number(value: float, figure: Figure) -> str:
    return f"{value * figure.scale:,.{figure.digits}f}"


def mean_text(summary: Summary, figure: Figure) -> str:
    """`mean ± spread`; no spread for a single run."""
    spread = "" if math.isnan(summary.spread) else f" ± {number(summary.spread, figure)}"
    return number(summary.mean, figure) + spread


def difference_text(found: Difference, figure: Figure) -> str:
    """`+2.1 [1.0, 3.2]`, or `×0.48 [0.40, 0.55]`; no interval where there is one unit."""

    def shown(value: float) -> str:
        return f"{value:.2f}" if figure.ratio else number(value, figure)

    interval = "" if math.isnan(found.low) else f" [{shown(found.low)}, {shown(found.high)}]"
    sign = "×" if figure.ratio else "+" if found.mean >= 0 else ""
    return sign + shown(found.mean) + interval


def shown_figures(lines: list[Line]) -> list[Figure]:
    """Figures that at least one run has."""
    return [figure for figure in FIGURES if any(figure.key in line.summaries for line in lines)]


def labels(lines: list[Line]) -> list[str]:
    """What tells lines apart; a study of one condition or of the scenes' own budget does not name it."""
    return [name for name in ("condition", "budget", "variant") if any(getattr(line, name) for line in lines)]


def table_row(line: Line, lines: list[Line]) -> list[tuple[str, str, bool]]:
    """Cells of one of `lines` as (mean ± spread, paired difference, whether its interval excludes no effect)."""
    texts = [*(getattr(line, name) for name in labels(lines)), f"{line.n_done} of {line.n_runs}"]
    cells = [(text, "", False) for text in texts]
    for figure in shown_figures(lines):
        summary, difference = line.summaries.get(figure.key), line.differences.get(figure.key)
        mean = "-" if summary is None else mean_text(summary, figure)
        change = "" if difference is None else difference_text(difference, figure)
        cells.append((mean, change, difference is not None and difference.excluded))
    return cells


def scene_table(rows: list[Row]) -> list[list[str]]:
    """Header and rows: each scene apart, mean ± spread over seeds (and, in sequences, over orders)."""
    done = [row for row in counted(rows) if row["state"] == "done"]
    figures = [
        figure for figure in FIGURES if figure.key in BY_SCENE and any(row[figure.key] is not None for row in done)
    ]
    names = [name for name in ("scene", "condition", "budget", "variant") if any(row[name] for row in done)]
    table = [[*names, *(figure.heading for figure in figures)]]
    for where, members in sorted(groups(done, *names).items(), key=lambda item: item[0][0]):
        cells = list(where)
        for figure in figures:
            values = [row[figure.key] for row in members if row[figure.key] is not None]
            cells.append(mean_text(summarize(values), figure) if values else "-")
        table.append(cells)
    return table


def missing(rows: list[Row]) -> list[tuple[str, str]]:
    """(run, why) of every run without figures."""
    keys = ("scene", "condition", "variant", "budget", "sequence")
    return [
        (", ".join(str(row[k]) for k in keys if row[k]) + f", seed {row['seed']}", row["state"])
        for row in rows
        if row["state"] != "done"
    ]


def left_out(rows: list[Row]) -> list[tuple[str, str, str]]:
    """(what, why, by which variants) of all that finished runs left out."""
    done = [row for row in rows if row["state"] == "done"]
    every = list(dict.fromkeys(row["variant"] for row in done))
    found: dict[tuple[str, str], dict[str, None]] = {}
    for row in done:
        for entry in row["left_out"].items():
            found.setdefault(entry, {})[row["variant"]] = None
    return sorted((*entry, "all" if len(by) == len(every) else ", ".join(by)) for entry, by in found.items())


def stability(path: Path) -> list[tuple[str, int, int, float]]:
    """(part, cases, cases failed, largest error ÷ its tolerance) of the last `make stability`; none if it never ran."""
    if not path.is_file():
        return []
    with path.open(newline="") as handle:
        modules = groups(list(csv.DictReader(handle)), "module")

    def share(case: Row) -> float:
        error, tolerance = float(case["error"]), float(case["tolerance"])
        return error / tolerance if tolerance else 0.0 if error == 0 else math.inf

    return [
        (module, len(cases), sum(case["passed"] != "True" for case in cases), max(map(share, cases)))
        for (module,), cases in modules.items()
    ]


def note(study: Study, rows: list[Row]) -> str:
    """How to read the table."""
    n_scenes = len({row["scene"] for row in rows})
    unit = f"Student's over the {n_scenes} scenes" if n_scenes > 1 else "Student's over the seeds of the one scene"
    first = (
        " Of a sequence neither the first scene, which has no earlier knowledge, nor one that comes again is counted."
        if study.sequences
        else ""
    )
    if any(hasattr(protocols.ALL[row["protocol"]], "over_scenes") for row in rows):
        first += " mIoU, mAcc and OA are of all scenes of a seed together, as the protocol has it."
    return (
        f"Mean ± standard deviation over scenes and seeds, on the views of the protocol. Below it: the mean difference "
        f"(× ratio) from {study.baseline} of runs with the same scene, seed, condition and budget, with its "
        f"95 % interval ({unit}); bold where the interval excludes no effect.{first}"
    )  # fmt: skip


def facts(runs: list[Run], rows: list[Row], command: str) -> list[tuple[str, str]]:
    """Where the figures come from."""
    done = [(run, row) for run, row in zip(runs, rows, strict=True) if row["state"] == "done"]
    manifests = [artifact.read_manifest(run.plan.targets["train"]) for run, _ in done]
    threads = sorted({m.threads for m in manifests})
    versions = {f"{k} {v}" for m in manifests for k, v in m.versions.items()}
    commits = {
        m.code["commit"][:10] + (" with changes" if m.code.get("dirty") else "")
        for m in manifests
        if "commit" in m.code
    }
    found = [
        ("command", command),
        ("protocol", ", ".join(sorted({row["protocol"] for row in rows}))),
        ("runs", f"{len(done)} of {len(rows)} done; {len({m.key for m in manifests})} different trainings"),
        ("device", ", ".join(sorted({m.device for m in manifests})) + f" ({processor()})"),
        ("threads a run", ", ".join(map(str, threads))),
        ("versions", ", ".join(sorted(versions))),
        ("commit", ", ".join(sorted(commits)) or "not in a checkout"),
    ]
    if len(threads) > 1:
        found.append(("beware", "seconds and frames/s of runs with different numbers of threads do not compare"))
    return found


def processor() -> str:
    """The processor's name, where the system tells it."""
    import platform

    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def markdown(parts: dict[str, Any]) -> str:
    """The study's section of docs/results.md."""
    study = parts["study"]
    text = [f"## {study.title}", "", study.about, "", *(f"- {what}: {value}" for what, value in parts["facts"])]
    text += ["", f"![error against run time]({PICTURE})", "", parts["note"], ""]
    rows = [[f"{a}<br>{f'**{b}**' if bold else b}" if b else a for a, b, bold in row] for _, row in parts["table"]]
    tables = [("", "", "", [parts["header"], *rows])]
    tables += [(f"### {s.heading}", s.note, s.picture, s.table) for s in parts["more"]]
    for heading, note, picture, table in (*tables, ("### Each scene", "", "", parts["scenes"])):
        text += [heading, ""] if heading else []
        text += [note, ""] if note else []
        text += [f"![{heading.strip('# ')}]({picture})", ""] if picture else []
        text += ["| " + " | ".join(row) + " |" for row in table[:1]]
        text += ["|" + "---|" * len(table[0])]
        text += ["| " + " | ".join(row) + " |" for row in table[1:]] + [""]
    if parts["stability"]:
        text += ["### Extreme cases (`make stability`)", "", "| part | cases | failed | largest error ÷ tolerance |"]
        text += ["|---|---|---|---|", *(f"| {m} | {n} | {bad} | {e:.2g} |" for m, n, bad, e in parts["stability"]), ""]
    if parts["left_out"]:
        text += ["### Left out, and why", ""]
        text += [*(f"- {what}: {why} ({by})" for what, why, by in parts["left_out"]), ""]
    if parts["missing"]:
        text += ["### Runs without figures", "", *(f"- {run}: {why}" for run, why in parts["missing"]), ""]
    return "\n".join(text)
