"""A scene's teacher, starting knowledge and source, and the stages it leaves out and why."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError
from chebsplat.formats.extras import require
from chebsplat.formats.images import is_heic, is_image, require_heic
from chebsplat.formats.knowledge import SCHEMA, SHIPPED, read_card
from chebsplat.formats.teacher_model import (
    EMBEDDED,
    TEXT_PACKAGE,
    TeacherModel,
    read_label_set,
    read_label_table,
    read_teacher,
)
from chebsplat.formats.videos import is_video, require_av
from chebsplat.pipelines.work import store
from chebsplat.pipelines.work.scenes import expand_variables
from chebsplat.stages.settings import FETCH, NAMED_LATER
from chebsplat.stages.sources.common import unread
from chebsplat.stages.teacher_models.text_encoder import PACKAGE, match_names

LIFTED = "train.features is lifted"
# kinds of sources with photos of any place
PHOTOGRAPHS = ("photos", "colmap", "transforms", "seven_scenes", "video")
POSELESS = ("photos", "video")  # kinds without poses
UNASKED = "no 2D teacher is named"
HOW = (
    f"to label photographs, fetch one with `{FETCH}` and name it by set=teacher.model=MODEL.onnx "
    "(docs/teachers.md); the embedded one (set=teacher.kind=embedded) was trained on generated "
    "rooms only"
)

LATER = f"to name what is in it, without training again: the same command with set={NAMED_LATER}"


def teacher_kind(config: Any, source: str, probe: dict[str, bool]) -> tuple[str, str]:
    """The teacher's kind after `auto` is resolved, and the reason where it is none.

    Args: source: its kind; probe: what it has.
    Choices: photographs without labels get the embedded teacher only if it is asked for: its labels
      of photographs are noise.
    """
    kind = config.teacher.kind
    if not config.train.semantics:
        return "none", "train.semantics is false"
    if kind == "labels" and not probe["labels"]:
        raise ConfigError(
            "teacher.kind is labels, but the source has none; use "
            "teacher.kind=auto, or teacher.model"
        )
    if kind == "given" and not probe.get("pseudo_labels"):
        raise ConfigError(
            "teacher.kind is given, but the source brings no pseudo labels; use teacher.kind=auto"
        )
    if config.teacher.model and kind in ("embedded", "labels", "given", "none"):
        raise ConfigError(
            f"teacher.kind is {kind}, so teacher.model would not be used; set teacher.kind=onnx too"
        )
    if kind == "none":
        return "none", "teacher.kind is none"
    if (
        kind == "auto"
        and not config.teacher.model
        and source in PHOTOGRAPHS
        and not probe["labels"]
    ):
        return "none", UNASKED
    return ("onnx" if kind in ("auto", "embedded") else kind), ""


def left_out_stages(config: Any, kind: str, why: str, probe: dict[str, bool]) -> dict[str, str]:
    """Stages that this scene leaves out, by reason.

    Raises: ConfigError on the printed method without a teacher.
    """
    left_out: dict[str, str] = {}
    if kind == "none" and config.train.method == "printed":
        raise ConfigError(
            f"train.method is printed, which needs a teacher, and {why}; name one with teacher.kind"
        )
    if kind == "none":
        left_out |= {"teacher": f"{why}; {HOW}" if why == UNASKED else why}
        left_out |= {"lift": f"no teacher's features to lift ({why})"}
        left_out |= {
            "refine": f"no semantic features to refine ({why})",
            "agree": f"no teacher's labels ({why})",
        }
    if config.train.method == "printed" or (
        config.refine.changes_nothing and config.knowledge.start == "none"
    ):
        printed = config.train.method == "printed"
        reason = (
            "the printed method ends with its training"
            if printed
            else "refine is asked for nothing"
        )
        left_out |= {"lift": reason, "refine": reason}
    if config.source.kind not in POSELESS:
        left_out["pose"] = "the source brings poses"
    if probe["poses"] and config.sfm.poses != "adjusted":
        tested = config.sfm.poses == "auto" and config.source.kind != "generated"
        has_depth = probe["depth"] and config.ingest.depth == "auto"
        what, inputs = (
            ("matching", "poses and depth") if has_depth else ("pose estimation", "poses")
        )
        left_out[f"sfm: {what}"] = f"{inputs} are given" + (
            ", and kept if they fit the photos" if tested else ""
        )
    return left_out


def unread_inputs(config: Any, stage: str) -> set[str]:
    """Roles of a stage's existing inputs that this configuration does not read."""
    lifted = config.train.features == "lifted"
    return {"train": {"features"} if lifted else set(), "export": {"lifted"}}.get(stage, set())


def colours_alone(config: Any) -> Any:
    """The settings of a training without features: the same without a teacher and with features
    that are lifted later, so that a finished scene is labelled without training again.
    """
    meaningless = {"semantics": True, "features": "trained", "feature_start": None}
    return config.model_copy(update={"train": config.train.model_copy(update=meaningless)})


def left_out_channels(kind: str, model: TeacherModel | None) -> dict[str, str]:
    """The reason why a scene trains in its teacher's own channels, if it does."""
    if model is None:
        return {"channels": f"teacher.kind is {kind}: no teacher's channels to reduce"}
    if model.output != "features":
        return {
            "channels": f"{model.name} is a closed-set teacher: its classes have codes of few "
            "channels"
        }
    return {}


def text_packages(model: TeacherModel | None, labels: str | None) -> tuple[str, ...]:
    """Packages that a teacher's text encoder runs on, if the scene needs embeddings of words.

    Args: labels: the file of labels, `teacher.labels`.
    Choices: the class names of a capture are unknown before it is read. The sentence model of the
      extra `text` has a fixed version, so it is not counted where only such names could need it; a
      user's own model is.
    Raises: ConfigError with the command that installs it, where words need one that is missing.
    """
    if model is None or model.text is None or model.output != "features":
        return ()
    encoder = PACKAGE if model.text == TEXT_PACKAGE else "tokenizers"
    groups = read_label_set(Path(labels)).values() if labels else []
    words = [word for synonyms in groups for word in synonyms]
    table = read_label_table(model.labels)[0] if model.labels and words else []
    lacks = model.labels is None or -1 in match_names(words, table, last_word=False)
    if lacks:
        require(encoder, f"{labels or model.name} asks for words that no table holds, which")
    if encoder == "tokenizers":
        return (encoder,)
    return (PACKAGE, "sentence_transformers", "tokenizers", "torch", "transformers") * lacks


def media_packages(files: Iterable[Path]) -> tuple[str, ...]:
    """Packages of extras that read some raw files: of HEIC photos, told by content, and of videos.

    Raises: InputError with the command that installs one that is missing.
    """
    used = {}
    for path in files:
        if is_video(path.name):
            used["av"] = path
        elif is_image(path.name) and is_heic(path):
            used["pillow_heif"] = path
    if "av" in used:
        require_av(used["av"])
    if "pillow_heif" in used:
        require_heic(used["pillow_heif"])
    return tuple(sorted(used))


def source_sentence(name: str, setting: Any, source: Any) -> str:
    """The source that was resolved, in a sentence for the console."""
    if source.kind != "generated":
        caution = "" if source.kind == "video" else unread(Path(source.path))
        return f"{source.kind} source at {source.path}{caution and f' ({caution})'}"
    note = ""
    if setting.kind == "named":
        note = (
            " (REPLICA_ROOT has no such scene)"
            if os.environ.get("REPLICA_ROOT")
            else " (REPLICA_ROOT is not set)"
        )
    return f"generated scene {name}: preset {source.preset}, seed {source.seed}{note}"


@dataclass
class Start:
    """The knowledge that a scene starts from: its artifact in the store, and the name of the set of
    lessons that it reads and adds its own to; `why` there is no artifact, or no set.
    """

    path: Path | None = None
    lessons: str | None = None
    why: str = ""


def choose_start(config: Any, kind: str, running: bool) -> Start:
    """The knowledge that a scene starts from, by its settings and teacher.

    Args: kind: of its teacher; running: the artifact is copied into the store.
    Raises: InputError on a damaged artifact.
    Choices: a scene of labels or of a segmenter starts from that of the embedded teacher, mapped
      through words.
    """
    start = config.knowledge.start
    if start == "none":
        return Start(why="knowledge.start is none")
    if "/" in start:
        folder = Path(expand_variables(start)).expanduser().resolve()
        return Start(
            store.import_artifact(folder, "teach", SCHEMA, running),
            None,
            "knowledge.start is a folder",
        )
    model = read_teacher(Path(config.teacher.model or EMBEDDED)) if kind == "onnx" else None
    if (
        model is not None
        and model.output == "features"
        and model.name != read_card(SHIPPED)["teacher"]
    ):
        return Start(
            why=f"none was taught for the teacher {model.name}; `chebsplat knowledge teach` does"
        )
    path = store.import_artifact(SHIPPED, "teach", SCHEMA, running)
    if start == "shipped":
        return Start(path, None, "knowledge.start is shipped")
    return Start(path, start)
