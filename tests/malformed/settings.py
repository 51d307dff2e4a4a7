"""Settings that no scene could use: refused before a stage begins, in a config and in `--set`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from malformed.case import Asked, Case, stage

INF, NAN = float("inf"), float("nan")
BAD: dict[str, list[object]] = {  # setting: values that JSON, or Python's JSON, can hold
    "scene.name": ["", "a\nb", "a\0b", "x" * 5000, 5, None],
    "source.kind": ["coLmap", 3, None],
    "source.path": ["", "a\0b", "x" * 5000, ["a"]],
    "source.seed": [-1, 2**64, 1.0],
    "ingest.protocol": ["label"],
    "ingest.test_every": [0, 1, 10**9],
    "ingest.max_side": [0, 8, 10**6, "640"],
    "ingest.min_views": [0, -3],
    "sfm.max_points": [0, 10**9, INF],
    "sfm.n_neighbors": [10**6],
    "sfm.peak_threshold": [0, -1.0, NAN],
    "sfm.min_registered": [0, 1.5],
    "teacher.n_channels": [1, 10**6, 1e6],
    "teacher.downscale": [0, 10**4, True],
    "teacher.scales": [[], [0.0], [-1.0], [INF], [1e9], "1", [1.0] * 100, [True]],
    "teacher.confusion": [-0.1, 1.1, NAN],
    "teacher.blur": [-1.0, 1e6, INF],
    "teacher.noise": [-1, 1e9],
    "teacher.model": ["", "a\nb", 7],
    "channels.n_channels": [1, 1000],
    "channels.n_rooms": [0, 10**6],
    "describe.n_angles": [0, 10**4],
    "describe.max_degree": [1, 10**5],
    "describe.bandwidth": [0.0, -1.0, INF],
    "describe.n_regions": [0, 10**9],
    "describe.spectrum": [["full"]],
    "train.steps": [0, -1, 10**12, 1.5, "many", True, 10**400],
    "train.seconds": [0, -1.0, INF, 1e300],
    "train.seed": [-1, 2**31, 2**64, 2**70, "0"],
    "train.semantics": [1, "yes"],
    "train.max_gaussians": [0, 10**10],
    "train.n_layers": [-1, 0, 1.5, "two", 10**6],
    "train.width": [0, 10**7, 30],
    "train.n_heads": [0, 3, 10**6],
    "train.lr_means": [-1, NAN, INF, 1e30],
    "train.weight_features": [-1.0, INF],
    "train.coarse_until": [-0.1, 2],
    "train.densify_until": [0.9],
    "train.report_every": [0],
    "lift.gate": [-0.1, 1.5, NAN],
    "lift.median_steps": [-1, 0.5, 10**6],
    "lift.min_weight": [-1.0, INF],
    "onnx.opset": [1, 17, 99],
    "onnx.tolerance": [0, NAN],
    "cks.max_rank": [0, 1, -1],
    "evaluate.timing_repeats": [-1, 10**9],
    "report.n_pictures": [0, 10**6],
    "train.stpes": [5],
}
SET = {  # --set: what stderr names
    "train.steps": "section.key=value",
    "train.steps=": "train.steps",
    "=5": "=5",
    "train=5": "train=5",
    "train.steps.more=5": "train.steps.more",
    "train.steps=5,train.steps=6": "train.steps is given twice",
    "train.steps=5, train.steps=6": "train.steps is given twice",
    "train.steps=nan": "train.steps",
    "train.lr_means=inf": "train.lr_means",
    "train.steps=" + "9" * 5000: "train.steps",
    "train.steps=" + "[" * 5000: "train.steps",
    "train.seed=-1": "train.seed",
    "teacher.labels=a\nb": "teacher.labels",
    "train.n_layers=1e6": "train.n_layers",
    "train.max_gaussians=true": "train.max_gaussians",
    "describe.n_regions=200000,describe.n_angles=64": "descriptors of",
}


def _case(setting: str, value: object) -> Case:
    section, key = setting.split(".")
    together = {"train.densify_until": "densify_until", "train.width": "width", "train.n_heads": "width"}
    named = together[setting] if setting in together and value in (0.9, 30, 3) else setting

    def build(folder: Path) -> Asked:
        return stage("ingest", folder, {section: {key: value}}, named)

    return Case("setting", f"{setting} = {value!r:.40}", build, (2,))


def cases() -> Iterator[Case]:
    for setting, values in BAD.items():
        for value in values:
            yield _case(setting, value)
    for text, named in SET.items():
        asked = Asked(["plan", "--scene", "toy", "--set", text], named)
        yield Case("set=", f"{text[:40]!r}", lambda folder, asked=asked: asked, (2,))
