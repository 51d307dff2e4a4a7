"""Forecast of the seconds, megabytes and memory of a plan: by photos, pixels and settings, the
seconds corrected by those of scenes that this machine has finished.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats.images import header, is_image
from chebsplat.formats.manifest import Manifest, parse_manifest
from chebsplat.formats.videos import describe
from chebsplat.pipelines.planning.needs import UNASKED
from chebsplat.pipelines.planning.plan import Plan, Step
from chebsplat.pipelines.planning.raw import raw_files
from chebsplat.pipelines.work import finished, store
from chebsplat.settings import default_gaussians, default_steps
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.machine import processor
from chebsplat.stages.runtime.progress import duration
from chebsplat.stages.settings import FETCH
from chebsplat.stages.sources.common import OWN_SIDE, is_photo
from chebsplat.stages.sources.generated import SIZES
from chebsplat.stages.sources.video import MOST

MANY = 150  # photos: from here on it is said what fewer would save
EXHAUSTIVE = 100  # photos, of which all pairs are matched
LARGEST = 0.31  # megapixels that a training step sees, at most: finer photos are seen in windows
KNOWN = 20.0  # s by which the default seconds of a stage are believed beside measured ones
PARALLEL = 0.7  # of the work of a stage: what more cores shorten
BEGIN = 2.5  # s until a process of a stage has begun
ON_GPU = 0.3  # of the CPU's seconds, for a stage that computes on a GPU: an H200's training
N_FINISHED = 8  # scenes whose seconds count, the newest


@dataclass(frozen=True)
class SceneFacts:
    """Facts of a scene before it is run.

    kind: of its source. raw, posed, trained: megapixels of all photos as they were taken, and as
    `pose` and `ingest` reduce them; compared: of one as `evaluate` does. pairs: of photos that
    `pose` matches. steps, clock: of the training, clock: s, None: as long as the steps take.
    gaussians: at most, of points of measured depth; others take up to 1.5 times the training.
    model: a 2D teacher's model is run.
    """

    kind: str
    photos: int
    raw: float
    posed: float
    trained: float
    compared: float
    pairs: int
    steps: int
    clock: float | None
    gaussians: int
    printed: bool
    semantic: bool
    model: bool

    @property
    def rich(self) -> float:
        """Features of a photo, as a share of a large one's."""
        return min(self.posed / self.photos / LARGEST, 1)

    @property
    def step(self) -> float:
        """Seconds of a training step."""
        colour = 0.010 + 0.075 * min(self.trained / self.photos, LARGEST)
        colour *= 0.5 + 0.5 * self.gaussians / 40_000
        return colour * (8 if self.printed else 1.2 if self.semantic else 1)


@dataclass(frozen=True)
class Forecast:
    """Of the steps of one plan that are to run: seconds, by stage, and MB that they write; memory:
    MB that one of them has at most; saved: s that MANY of the photos would spare where there are
    more.
    """

    photos: int
    seconds: dict[str, float]
    megabytes: float
    memory: float
    saved: float = 0.0

    @property
    def total(self) -> float:
        """Seconds, with those in which processes begin."""
        return sum(self.seconds.values()) + BEGIN * len(self.seconds)


def facts_of(
    stages: Mapping[str, dict[str, Any]], semantic: bool, fewer: int | None = None
) -> SceneFacts | None:
    """Facts of a scene by its settings and source; None where no photo can be read.

    Args: stages: sections of the config by stage, of a plan or of a finished scene; semantic: the
      training reads features; fewer: photos, in the place of more.
    """
    ingest = stages["ingest"]["ingest"]
    source, pose = stages["ingest"]["source"], stages.get("pose", {}).get("pose", {})
    with suppress(InputError):
        n, width, height = photos_of(source, stages["ingest"])
        if source["kind"] == "video" and pose.get("max_views") is None:
            n = min(n, MOST)
        n = min(filter(None, (n, pose.get("max_views"), ingest["max_views"], fewer)))
        area, side = width * height / 1e6, max(width, height)
        reduced = area * min(1, ingest["max_side"] / side) ** 2
        train = stages.get("train", {}).get("train", {})
        teacher = stages.get("teacher", {}).get("teacher", {})
        all_pairs = pose.get("matching") == "exhaustive" or n <= EXHAUSTIVE
        n_training_pixels = (n - n // (ingest["test_every"] or 8)) * reduced * 1e6
        return SceneFacts(
            source["kind"],
            n,
            n * area,
            n * area * min(1, pose.get("max_side", side) / side) ** 2,
            n * reduced,
            area * min(1, OWN_SIDE / side) ** 2,
            n * (n - 1) // 2 if all_pairs else round(0.6 * pose.get("n_matched", 10) * n),
            train.get("steps") or default_steps(n_training_pixels),
            train.get("seconds"),
            train.get("max_gaussians") or default_gaussians(n_training_pixels, measured=True),
            train.get("method") == "printed",
            semantic,
            teacher.get("model") is not None,
        )
    return None


def photos_of(source: dict[str, Any], sections: dict[str, Any]) -> tuple[int, int, int]:
    """Number of photos of a source, and (width, height) of one. Raises InputError where none can
    be read.
    """
    if source["kind"] == "generated":
        return SIZES[source["preset"]]
    files = raw_files("ingest", sections)[1]
    if source["kind"] == "video":
        video = describe(files[0])
        return video.n_frames, video.width, video.height
    root = Path(source["path"])
    photos = [path for path in files if is_image(path.name) and is_photo(path, root)]
    if not photos:
        raise InputError(f"{root} holds no photo; correct source.path")
    return len(photos), *header(photos[len(photos) // 2])[0]


def rates(cores: int, device: str) -> dict[str, float]:
    """By stage, how many times its `seconds` a run on so many cores takes.

    Choices: more cores than two shorten PARALLEL of the work, and a GPU takes ON_GPU of what it
      computes. The newest scenes that this machine has finished correct that, by the sum of their
      seconds over the sum of what they should have been, KNOWN s of each being as expected: scenes
      of seconds say little of those of minutes.
    """
    base, by_cores = store.work(), 1 - PARALLEL + PARALLEL * 2 / cores
    defaults = {s: by_cores * (ON_GPU if device_of(s, device) == "cuda" else 1) for s in STAGES}
    spent, awaited = dict.fromkeys(STAGES, KNOWN), dict.fromkeys(STAGES, KNOWN)
    newest = sorted(finished.titles(), key=lambda title: -(base / title).stat().st_mtime)
    for title in newest[:N_FINISHED]:
        manifests = {}
        for stage, path in finished.links(base / title).items():
            with suppress(InputError):  # damaged: nothing can be learnt of it
                manifests[stage] = parse_manifest(path)
        try:
            semantic = "train" in manifests and "features" in manifests["train"].inputs
            of = facts_of(
                {stage: manifest.config for stage, manifest in manifests.items()}, semantic
            )
        except KeyError:  # of a study, or made by another version, with other settings
            continue
        for stage in manifests.keys() & STAGES:
            if of is not None and is_alike(manifests[stage], cores, device):
                spent[stage] += idle_seconds(manifests[stage])
                awaited[stage] += defaults[stage] * STAGES[stage].seconds(of)
    return {stage: defaults[stage] * spent[stage] / awaited[stage] for stage in STAGES}


def is_alike(manifest: Manifest, cores: int, device: str) -> bool:
    """True for an artifact made on this processor, with so many threads, on such a device."""
    return bool(manifest.processes) and all(
        (of["processor"], of["threads"]) == (processor(), cores)
        and manifest.device == device_of(manifest.stage, device)
        for of in manifest.processes
    )


def device_of(stage: str, device: str) -> str:
    """The device of a stage in a run on `device`."""
    return device if STAGES[stage].on_device else "cpu"


def idle_seconds(manifest: Manifest) -> float:
    """Seconds that its processes would have taken alone: of more processes than cores each has had
    a part.
    """
    return sum(
        of["seconds"] * min(1, of["cores"] / max(sum(of["load"]) / 2, 1e-9))
        for of in manifest.processes
    )


def forecast(plan: Plan, steps: Iterable[Step], cores: int, device: str) -> Forecast | None:
    """Forecast of `steps` of a plan, which are to run; None where no photo can be read."""
    sections = {step.stage: step.sections for step in plan.steps}
    semantic = any(step.stage == "train" and "features" in step.inputs for step in plan.steps)
    now, stages = facts_of(sections, semantic), [step.stage for step in steps]
    if now is None:
        return None
    factors = rates(cores, device)

    def seconds(of: SceneFacts) -> dict[str, float]:
        return {stage: STAGES[stage].seconds(of) * factors[stage] for stage in stages}

    expected, saved = seconds(now), 0.0
    # of photos that are read already, fewer would be read anew
    if "ingest" in stages and now.photos > MANY and (fewer := facts_of(sections, semantic, MANY)):
        saved = sum(expected.values()) - sum(seconds(fewer).values())
    size = sum(STAGES[stage].megabytes(now) for stage in stages)
    memory = max((STAGES[stage].memory(now) for stage in stages), default=0.0)
    return Forecast(now.photos, expected, size, memory, saved)


def sentence(plan: Plan, expected: Forecast | None, cores: int, device: str) -> str:
    """A forecast in words, with what a scene of colour alone lacks and what fewer photos save."""
    if expected is None:
        return "no forecast: none of its photos can be read"
    where = f"{cores} core{'s' * (cores > 1)}" + " and the GPU" * (device == "cuda")
    text = f"{expected.photos} photos, "
    megabytes = max(round(expected.megabytes, -1), 10)
    text += (
        f"about {duration(expected.total)} on {where}, {megabytes:.0f} MB, "
        f"about {expected.memory / 1000:.1f} GB of memory"
        if expected.seconds
        else "all is done"
    )
    if plan.left_out.get("teacher", "").startswith(UNASKED):
        text += f"; colour only: for names run `{FETCH}`"
    if expected.saved > BEGIN:
        setting = "pose" if "pose" in plan.targets else "ingest"
        text += (
            f"; {MANY} of the photos would take about {duration(expected.saved)} less: "
            f"set={setting}.max_views={MANY}"
        )
    return text
