"""Whether what a study has written is still what it would write: then a study that is done answers at once."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import chebsplat
from chebsplat.evaluation import statistics
from chebsplat.formats.files import atomic_write
from chebsplat.pipelines.studies import page
from chebsplat.pipelines.studies.study import Run, Study
from chebsplat.stages.pages import template

WRITERS = [
    Path(module.__file__ or "").parent for module in (page, statistics, template)
]  # folders of the code of pages
STAMP = ".written"


def identity(study: Study, runs: list[Run], command: str) -> str:
    """A digest of all that the page of a study depends on, whose runs are all done."""
    files = sorted(path for folder in WRITERS for path in folder.glob("*") if path.is_file())
    files += [page.STABILITY] if page.STABILITY.is_file() else []
    states = [(str(path), path.stat().st_mtime_ns, path.stat().st_size) for path in files]
    keys = [(run.name, {stage: path.name for stage, path in run.plan.targets.items()}) for run in runs]
    text = json.dumps([chebsplat.__version__, states, study.model_dump(mode="json"), keys, command, page.processor()])
    return hashlib.sha256(text.encode()).hexdigest()


def written(folder: Path) -> dict[str, list[int]]:
    """What lies in a study's folder, as a change of it would show."""
    files = (path for path in sorted(folder.glob("*")) if path.is_file() and path.name != STAMP)
    return {path.name: [path.stat().st_mtime_ns, path.stat().st_size] for path in files}


def keep(folder: Path, now: str) -> None:
    """Remember of what the folder was written."""
    atomic_write(folder / STAMP, json.dumps({"identity": now, "files": written(folder)}))


def is_current(folder: Path, now: str) -> bool:
    """Whether the folder was written of this, and is as it was left."""
    try:
        return bool(json.loads((folder / STAMP).read_text()) == {"identity": now, "files": written(folder)})
    except (OSError, ValueError, RecursionError):
        return False
