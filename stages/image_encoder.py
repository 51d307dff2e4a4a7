"""A user's image encoder in ONNX, `[1, 3, H, W]` float32 -> `[1, C, h, w]`, run over the views."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import ConfigError, InputError
from chebsplat.stages.command import Job

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.capture import Capture
    from chebsplat.formats.features import Features
    from chebsplat.stages.config import TeacherSection


def encode_views(job: Job, capture: Capture, settings: TeacherSection) -> Features:
    """Features of every view.

    Raises: ConfigError without a model or labels file; InputError naming a file that cannot be used.
    Choices: channels beyond `teacher.n_channels` are reduced by the projection that is stored in the labels file
      (`projection` [C, n_channels]); it belongs to the teacher, never to a scene, so none is made up here.
    """
    import numpy as np

    from chebsplat import noisy_teacher as model
    from chebsplat.formats.features import Features

    if not settings.model or not settings.labels:
        raise ConfigError("an ONNX teacher needs teacher.model and teacher.labels (.npz with names and embeddings)")
    names, embeddings, projection = _labels(Path(settings.labels))
    session = _session(Path(settings.model))
    entry = session.get_inputs()[0].name
    mean, std = (np.array(v, np.float32)[:, None, None] for v in (settings.mean, settings.std))
    rows = []
    for view, _ in job.progress.track(range(len(capture.names)), len(capture.names), "teacher"):
        image = _sized(capture.images[view], settings.size).astype(np.float32).transpose(2, 0, 1) / 255
        found = np.asarray(session.run(None, {entry: ((image - mean) / std)[None]})[0])
        if found.ndim != 4 or found.shape[1] != len(embeddings[0]):
            raise InputError(
                f"{settings.model} gives {found.shape} for one image; [1, {len(embeddings[0])}, h, w] is needed to "
                f"match the embeddings of {settings.labels}"
            )
        features = found[0].transpose(1, 2, 0)
        if projection is not None:
            features = features @ projection
        rows.append((features / np.linalg.norm(features, axis=-1, keepdims=True).clip(1e-6)).astype(np.float16))
    stacked = np.stack(rows)
    if projection is not None:
        embeddings = embeddings @ projection
    embeddings = embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True).clip(1e-6)
    if stacked.shape[-1] > 64:
        raise ConfigError(
            f"{settings.model} has {stacked.shape[-1]} channels, at most 64 can be rendered; store a `projection` "
            f"[{stacked.shape[-1]}, {settings.n_channels}] in {settings.labels}"
        )
    pseudo, confidence = model.decode(stacked.astype(np.float32), embeddings)
    convention = {"kind": "onnx", "normalized": True, "n_scales": 1, "flips": False, "size": settings.size}
    return Features(capture.names, stacked, names, embeddings, pseudo, confidence, convention)


def _labels(path: Path) -> tuple[list[str], np.ndarray, np.ndarray | None]:
    import numpy as np

    try:
        with np.load(path, allow_pickle=False) as arrays:
            held: dict[str, Any] = {name: arrays[name] for name in arrays.files}
        names, embeddings = [str(name) for name in held["names"]], held["embeddings"].astype(np.float32)
    except FileNotFoundError:
        raise InputError(f"{path} is missing; correct teacher.labels") from None
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path} is not an .npz with names and embeddings ({error}); write it again") from None
    projection = held.get("projection")
    if embeddings.ndim != 2 or len(embeddings) != len(names) or not np.isfinite(embeddings).all():
        raise InputError(f"{path}: embeddings {embeddings.shape} do not fit {len(names)} names; write it again")
    if projection is not None and (projection.ndim != 2 or len(projection) != embeddings.shape[1]):
        raise InputError(f"{path}: projection {projection.shape} does not fit {embeddings.shape[1]} channels")
    return names, embeddings, None if projection is None else projection.astype(np.float32)


def _session(path: Path) -> Any:
    import onnxruntime

    if not path.is_file():
        raise InputError(f"{path} is missing; correct teacher.model")
    try:
        return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exception types are not public
        raise InputError(f"{path} is not a usable ONNX model ({error}); export it again") from None


def _sized(image: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    import numpy as np
    from PIL import Image

    if size is None:
        return image
    return np.asarray(Image.fromarray(image).resize((size[1], size[0]), Image.Resampling.BILINEAR))
