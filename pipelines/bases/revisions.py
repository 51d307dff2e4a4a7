"""Bases by name: a revision of a sequence, of a HEAD that many processes share, or a folder that was exported."""

from __future__ import annotations

import shutil
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from chebsplat.errors import ConfigError
from chebsplat.formats import artifact, heads
from chebsplat.formats.basis import SCHEMA, read_lineage
from chebsplat.formats.names import suggest
from chebsplat.pipelines.planning.plan import Overrides, Plan, Planner
from chebsplat.pipelines.planning.sequences import chain, scenes_of
from chebsplat.pipelines.running import job
from chebsplat.pipelines.running.run import HERE, entry, git_state, plan_of
from chebsplat.pipelines.work import store
from chebsplat.pipelines.work.scenes import names
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime import config as configs
from chebsplat.stages.runtime.device import resolve

PREFIX = "basis-"  # of a HEAD's folder, whose links keep its artifacts


@dataclass(frozen=True)
class Reference:
    """`name[@revision]`; None: the newest."""

    name: str
    revision: int | None


def parse(text: str) -> Reference:
    """Raises ConfigError on a revision that is no number from 1."""
    name, at, number = text.rpartition("@")
    if not at:
        return Reference(text, None)
    if not name or not heads.NUMBER.fullmatch(number):
        raise ConfigError(f"basis={text}: NAME@REVISION is needed, such as offices@2")
    return Reference(name, int(number))


def head_folder(name: str) -> Path:
    """Raises ConfigError on a name that would lead elsewhere."""
    if not store.is_name(name):
        raise ConfigError(f"no basis is called {name}, and no folder: a HEAD has no / in it, and no . at its beginning")
    return store.work() / f"{PREFIX}{name}"


def head_names() -> list[str]:
    """HEADs in the work folder, sorted."""
    return sorted(path.name.removeprefix(PREFIX) for path in store.work().glob(f"{PREFIX}*") if path.is_dir())


def is_folder(text: str) -> bool:
    """Whether a reference names an exported folder: it has a slash, and is one."""
    return "/" in text and Path(text).expanduser().is_dir()


def is_sequence(name: str) -> bool:
    """Whether a reference names a sequence, of ours or by a .toml file."""
    return name in names("sequences") or name.endswith(".toml")


def chosen(reference: Reference, count: int) -> int:
    """The revision meant of `count`. Raises ConfigError if there are fewer."""
    if reference.revision is not None and reference.revision > count:
        raise ConfigError(f"{reference.name} has {count} revisions; there is no {reference.name}@{reference.revision}")
    return reference.revision or count


def before(planner: Planner, text: str, settings: Overrides, ablation: str) -> tuple[list[Plan], Path, str]:
    """What `basis=` means to a run: plans of the scenes it comes from, the artifact, and its name with the revision.

    Choices: the revision of a sequence is made where it is not there yet, with the settings of the scene that asks for
      it, so that `scene=C basis=AB@2` trains C as the sequence A, B, C would. A HEAD or a folder is taken as it is.
    Raises: ConfigError on a name or revision that does not exist; InputError on a damaged artifact.
    """
    if is_folder(text):
        path = store.taken_in(Path(text).expanduser(), "cks", SCHEMA, planner.running)
        return [], path, path.name
    reference = parse(text)
    if is_sequence(reference.name):
        number = chosen(reference, len(scenes_of(reference.name)))
        plans = chain(planner, reference.name, settings, ablation, number)
        if "cks" not in plans[-1].targets:
            raise ConfigError(f"{text} holds no knowledge: {plans[-1].left_out['cks']}")
        return plans, plans[-1].targets["cks"], f"{Path(reference.name).stem}@{number}"
    made = revisions_of_head(reference.name)
    number = chosen(reference, len(made))
    return [], made[number - 1], f"{reference.name}@{number}"


def revisions_of_head(name: str) -> list[Path]:
    """Raises ConfigError with the nearest names if there is no such HEAD."""
    made = heads.revisions(head_folder(name))
    if not made:
        known = [*head_names(), *names("sequences")]
        near = suggest(name, known) or known
        raise ConfigError(f"no basis is called {name}; did you mean {', '.join(near)}, or a folder (with a /)?")
    return made


def revisions(text: str) -> list[Path]:
    """Finished revisions up to the one meant, the oldest first; of a folder, that one alone.

    Raises: ConfigError on a name or revision that does not exist, or is not made yet.
    """
    if is_folder(text):
        artifact.read_manifest(Path(text).expanduser(), SCHEMA)
        return [Path(text).expanduser().resolve()]
    reference = parse(text)
    if not is_sequence(reference.name):
        found = revisions_of_head(reference.name)
        return found[: chosen(reference, len(found))]
    planner = Planner(device=resolve("auto")[0])  # what `make sequence=` takes unless it is told
    plans = chain(planner, reference.name, length=chosen(reference, len(scenes_of(reference.name))))
    planner.save()
    made = [plan.targets["cks"] for plan in plans]
    found = made[: next((k for k, path in enumerate(made) if not store.is_fresh(path)), None)]
    if len(found) < (reference.revision or 1):
        raise ConfigError(
            f"{text}: {len(found)} revisions of {reference.name} are made with the settings of its scenes as they are; "
            f"run make sequence={reference.name}, or name the folder of another (work/*/cks)"
        )
    return found


def extend(name: str, gaussians: Path, scene: str) -> list[Path]:
    """Add a trained scene's knowledge to a HEAD, which begins with it if there is none; returns its revisions.

    A scene that the HEAD knows already is not added again, so that a command that was killed may simply be repeated.
    Raises: ConfigError, and what the stage raises.
    """
    if is_sequence(name) or not store.is_name(name) or "@" in name:
        raise ConfigError(f"a HEAD cannot be called {name!r}: a sequence is, or it holds a / or @, or begins with a .")

    manifest, planner = artifact.read_manifest(gaussians, STAGES["train"].schema), Planner()
    config = configs.build({"scene": {"name": scene}}, f"scene {scene}")
    plans = ExitStack()

    def build(head: Path | None) -> Path | None:
        if head is not None and manifest.key in {entry["gaussians"] for entry in read_lineage(head)}:
            return None
        earlier = {} if head is None else {"basis": head}
        keys = {"gaussians": manifest.key} | {role: path.name for role, path in earlier.items()}
        step = planner.step(STAGES["cks"], config, {"gaussians": gaussians} | earlier, keys)
        # until the revision is linked, its plan keeps `clean-stale` from it
        plan = plans.enter_context(plan_of([entry(step, git_state(HERE)) | {"threads": 1}]))
        plans.callback(shutil.rmtree, plan.parent, ignore_errors=True)
        job.make(plan, step.key)
        return step.path

    try:
        with plans:
            return heads.extend(head_folder(name), build)
    finally:
        planner.save()
