"""Settings that no training could use: every section refuses them before a stage begins."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from malformed.case import Asked, Case, stage

BAD = {  # setting: values that JSON can hold
    "train.n_layers": [-1, 0, 1.5, "two", 10**6],
    "train.width": [0, 10**7],
}


def _case(setting: str, value: object) -> Case:
    section, key = setting.split(".")

    def build(folder: Path) -> Asked:
        return stage("ingest", folder, {section: {key: value}}, setting)

    return Case("setting", f"{setting} = {value!r}", build, (2,))


def cases() -> Iterator[Case]:
    for setting, values in BAD.items():
        for value in values:
            yield _case(setting, value)
