"""The names of a splat's Gaussians by shape and knowledge alone: no photo, no 2D teacher."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import ConfigError, InputError

if TYPE_CHECKING:
    import numpy as np

log = logging.getLogger("chebsplat")


def label_ply(
    ply: Path, knowledge: Path, words: list[str], up: np.ndarray, unit: float | None, out: Path
) -> dict[str, Any]:
    """Write the PLY again with a label a Gaussian, and beside it an .npz: names, labels [N], confidence f32 [N].

    Args:
      ply:       a 3DGS PLY of a room; knowledge: a `knowledge` artifact; words: to choose among.
      up:        [3] against gravity, in the PLY's frame; unit: its units in a metre; None: by the room's extent.
    Returns: counts, and the share of each name.
    Raises:  ConfigError if `out` exists or a word is not known; InputError on what cannot be read; DataFailure where
             the splat shows no surface.
    Choices: shape is described on the surface that is rendered from within, and carried to the Gaussians beside it. The
      confidence is that of the label among the words, times the length of the answer: how alike a teacher's views were
      where shapes were like this one.
    """
    import numpy as np
    from scipy.special import expit

    from chebsplat.formats.files import atomic_path
    from chebsplat.formats.knowledge import read_knowledge
    from chebsplat.formats.names import suggest
    from chebsplat.formats.ply import read_ply, write_ply
    from chebsplat.labels.decode import decode
    from chebsplat.lifting.carry import carry
    from chebsplat.lifting.smoothing import room_unit
    from chebsplat.lifting.surface import LOOKOUT_SIZE, lookouts
    from chebsplat.splats.gaussians import surface_of
    from chebsplat.stages.known_shapes import answered, shown
    from chebsplat.stages.text import found

    beside = out.with_suffix(".npz")
    for path in (out, beside):
        if path.exists():
            raise ConfigError(f"{path} exists; remove it, or choose another --out")
    held = read_knowledge(knowledge)
    rows = found(words, held.words)
    if -1 in rows:
        word = words[rows.index(-1)]
        near = ", ".join(suggest(word, held.words))
        raise ConfigError(f"{knowledge} has no word {word}" + (f"; near: {near}" if near else ""))
    parameters, degree, _ = read_ply(ply)
    if not len(parameters["means"]):
        raise InputError(f"{ply} holds no Gaussians; choose another")
    unit = room_unit(parameters["means"]) if unit is None else unit
    poses, Ks = lookouts(parameters["means"].astype(np.float64), expit(parameters["logit_opacities"]), up)
    cloud = shown(parameters, poses, Ks, LOOKOUT_SIZE, unit)
    log.info("%d points of a surface, %.3g units a metre", len(cloud.means), unit)
    answers = answered(knowledge, held, cloud, up, unit)
    normals = surface_of(parameters)[0]
    carried, _ = carry(answers, cloud.means, cloud.normals, parameters["means"], normals, unit)
    labels, sure = decode(carried, held.embeddings[rows].astype(np.float32))
    confidence = sure * np.linalg.norm(carried, axis=1).clip(0, 1)
    with atomic_path(beside) as temporary, temporary.open("wb") as stream:
        np.savez(stream, names=np.array(words), labels=labels, confidence=confidence.astype(np.float32))
    with atomic_path(out) as temporary:
        write_ply(temporary, parameters, degree, labels, words)
    shares = {word: float((labels == k).mean()) for k, word in enumerate(words)}
    return {"gaussians": len(labels), "points": len(cloud.means), "unit": unit, "shares": shares}
