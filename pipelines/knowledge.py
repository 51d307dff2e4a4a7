"""Knowledge by teacher: what teaches it, and which of it a scene is given."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import ConfigError
from chebsplat.formats.knowledge import SCHEMA, SHIPPED, read_card
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.pipelines import store
from chebsplat.pipelines.plan import Plan, Planner, merged, overrides, placed
from chebsplat.pipelines.scenes import expanded
from chebsplat.stages.registry import STAGES

if TYPE_CHECKING:
    from chebsplat.stages.runtime.config import Config


def teaching(planner: Planner, model: Path | None, settings: str = "") -> Plan:
    """The steps that teach knowledge for a teacher, the embedded one if none is named.

    Raises: ConfigError on a closed-set teacher, whose classes no shape is taught.
    """
    from chebsplat.stages.runtime import config as configs

    file = (model or EMBEDDED).expanduser().resolve()
    teacher = read_teacher(file)
    if teacher.output != "features":
        raise ConfigError(f"{teacher.settings}: output is {teacher.output}; knowledge is taught in features")
    of: dict[str, Any] = {"channels": {"model": str(file)}, "knowledge": {"model": str(file)} if model else {}}
    config = placed(configs.build(merged(of, overrides(settings)), f"knowledge for {teacher.name}"))
    channels = planner.step(STAGES["channels"], config, {}, {})
    inputs = {"channels": channels.path}
    teach = planner.step(STAGES["teach"], config, inputs, {"channels": channels.key})
    return Plan(f"knowledge-{teacher.name}", f"knowledge for the teacher {teacher.name}", [channels, teach])


def given(config: Config, kind: str, running: bool) -> tuple[Path | None, str]:
    """The knowledge that a scene is refined with, in the store, and why there is none if there is none.

    Raises: InputError on a damaged artifact.
    Choices: a scene of labels or of a segmenter is given that of the embedded teacher, which reaches it through words.
    """
    wanted = config.refine.knowledge
    if wanted == "none":
        return None, "refine.knowledge is none"
    if wanted is None and config.train.encoder != "points":
        return None, f"train.encoder is {config.train.encoder}"
    if wanted is not None:
        return store.taken_in(Path(expanded(wanted)).expanduser().resolve(), "teach", SCHEMA, running), ""
    model = read_teacher(Path(config.teacher.model or EMBEDDED)) if kind == "onnx" else None
    if model is not None and model.output == "features" and model.name != read_card(SHIPPED)["teacher"]:
        return None, f"none was taught for the teacher {model.name}; `chebsplat knowledge` teaches it"
    return store.taken_in(SHIPPED, "teach", SCHEMA, running), ""
