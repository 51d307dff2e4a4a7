"""Run a stage in this process or as a command: check its inputs, publish its one artifact."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import click

from chebsplat.formats import artifact
from chebsplat.formats.manifest import Manifest
from chebsplat.kernels.threads import n_threads
from chebsplat.stages.registry import MANY, STAGES, lesson_paths
from chebsplat.stages.runtime import config as configs
from chebsplat.stages.runtime.device import DEVICES, name_of, resolve
from chebsplat.stages.runtime.machine import Stopwatch
from chebsplat.stages.runtime.progress import Progress, log_level
from chebsplat.stages.runtime.stopping import exit_code

log = logging.getLogger("chebsplat")


@dataclass
class Job:
    """Inputs, settings and outputs of one run of a stage.

    `out` is the directory to fill; it becomes the artifact when `run` returns. `scratch` survives a
    kill, for stages that resume; these tell `watch` so. `facts` end up in the manifest: figures,
    choices, and parts left out with the reason.
    """

    inputs: dict[str, Path]
    config: configs.Config
    out: Path
    scratch: Path
    device: str = "cpu"
    progress: Progress = field(default_factory=Progress)
    facts: dict[str, Any] = field(default_factory=dict)
    watch: Stopwatch = field(default_factory=Stopwatch)

    def left_out(self, what: str, why: str) -> None:
        """Record that this scene does not need `what`: for the report, and the console with -v."""
        self.facts.setdefault("left_out", {})[what] = why
        log.debug("left out: %s (%s)", what, why)


def command(name: str, run: Callable[[Job], None]) -> click.Command:
    """The click command of stage `name`: inputs, a config, and an output, whose path it prints."""
    stage = STAGES[name]

    def invoke(out: Path, **options: Any) -> None:
        def action() -> None:
            inputs = {role: of for role in stage.roles if (of := options.pop(f"in_{role}"))}
            lessons = {artifact.read_manifest(path).key: path for path in inputs.pop(MANY, ())}
            publish(name, run, out, inputs | lesson_paths(lessons), **options)
            print(out.absolute())

        sys.exit(exit_code(action, out.absolute().parent))

    params: list[click.Parameter] = [
        click.Option(
            [f"--in-{role}"],
            type=click.Path(path_type=Path),
            required=(role, of) in stage.inputs,
            multiple=role == MANY,
            help=f"artifact of `{of}`"
            + ("" if (role, of) in stage.inputs else " (optional)")
            + (", once for each" if role == MANY else ""),
        )
        for role, of in (*stage.inputs, *stage.optional)
    ]
    params += [
        click.Option(
            ["--config"],
            type=click.Path(path_type=Path),
            help="TOML or JSON; defaults otherwise",
        ),
        click.Option(
            ["--out"],
            type=click.Path(path_type=Path),
            required=True,
            help="the artifact's directory",
        ),
        click.Option(["--device"], type=click.Choice(DEVICES), default="auto", show_default=True),
        click.Option(
            ["--force"],
            is_flag=True,
            help="run even if the artifact exists, and replace it; nothing else",
        ),
    ]
    return click.Command(name, params=params, callback=invoke, help=stage.help)


@dataclass
class Planned:
    """The planner's part of a step: its key (None: of settings and inputs alone), the identity of
    its code, a context to run within, which can raise on exit to keep the artifact from being
    published, and the seconds that it is expected to take.
    """

    key: str | None = None
    code: dict[str, Any] = field(default_factory=dict)
    within: AbstractContextManager[Any] = field(default_factory=nullcontext)
    expected: float | None = None


def publish(
    name: str,
    run: Callable[[Job], None],
    out: Path,
    inputs: dict[str, Path],
    config: Path | None = None,
    *,
    planned: Planned | None = None,
    device: str = "auto",
    force: bool = False,
) -> None:
    """Run one stage in this process and publish its artifact, unless it exists and not `force`.

    Args: inputs: artifacts by role; config: TOML or JSON, else defaults; planned: of a planner.
    Raises: ChebsplatError.
    """
    line = f"%(asctime)s {name}: %(message)s"
    logging.basicConfig(
        stream=sys.stderr, format=line, datefmt="%H:%M:%S", level="WARNING", force=True
    )
    log.setLevel(log_level())
    out, stage = out.absolute(), STAGES[name]
    if not force and artifact.is_whole(out, stage.schema):
        log.info("already there")
        return
    inputs = {role: path.absolute() for role, path in inputs.items()}
    job_config = configs.load(config) if config else configs.Config()
    schemas = stage.schemas(inputs)
    manifests = {role: artifact.read_manifest(path, schemas[role]) for role, path in inputs.items()}
    settings = job_config.sections(stage.sections)
    sources = {role: {"key": m.key, "schema": m.schema} for role, m in manifests.items()}
    device, why = resolve(device)
    device = stage.device(device, settings)
    computed = {} if device == "cpu" else {"device": device}
    planned = planned or Planned()
    progress = Progress(expected=planned.expected)
    key = planned.key or artifact.digest(
        {"stage": name, "config": settings, "inputs": sources} | computed
    )
    artifact.check_place(out, stage.schema, key, force)
    seed = next(
        (settings[s]["seed"] for s in reversed(stage.sections) if "seed" in settings[s]), None
    )
    if why:
        log.info("%s", why)
    manifest = Manifest(
        stage.schema,
        key,
        name,
        sources,
        settings,
        seed,
        device=device,
        threads=n_threads(),
        code=planned.code,
    )
    scratch, watch = out.parent / f".part-{out.name}", Stopwatch(n_threads(), name_of(device))
    with artifact.publish(out, manifest, force) as tmp, progress.alive(), planned.within:
        job = Job(inputs, job_config, tmp, scratch, device, progress, manifest.facts, watch)
        with progress.log_to(tmp / "log.jsonl"):
            run(job)
        manifest.processes = watch.processes()
        manifest.seconds = round(sum(of["seconds"] for of in manifest.processes), 3)
        manifest.versions = _versions()
    artifact.discard(scratch)
    if (jit := sys.modules.get("chebsplat.kernels.jit")) and jit.compilation.kernels:
        log.info(
            "compiled %d kernels in %.0f s, once", jit.compilation.kernels, jit.compilation.seconds
        )
    log.info("done in %.1f s", manifest.seconds)


def _versions() -> dict[str, str]:
    """Versions of the packages that the stage really loaded."""
    names = (
        "torch", "numpy", "scipy", "numba", "llvmlite", "pycolmap", "open3d", "zarr", "onnx",
        "onnxruntime", "PIL", "safetensors", "plyfile", "matplotlib", "av",
        "pillow_heif", "gsplat",
    )  # fmt: skip
    distributions = {"open3d": "open3d-cpu", "PIL": "pillow"}
    loaded = sorted(name for name in names if sys.modules.get(name))
    return {n: metadata.version(distributions.get(n, n)) for n in loaded} | {
        "python": sys.version.split()[0]
    }
