"""Test data made by code: a capture whose training photos have other colours and poses than they were taken with.

Test views stay as they are, and the mean disturbance is none, so that a scene that undoes it lies where the test views
are and has their colours.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from chebsplat.cameras import centers
from chebsplat.photos.exposures import relit

SEED = 0  # of all disturbances: the studies compare trainings on the same ones


def recolored(images: np.ndarray, is_test: np.ndarray, stops: float) -> np.ndarray:
    """Images u8 [V, H, W, 3] with an exposure of ± `stops` and a white balance of ± a quarter of it, by training view.

    Choices: linear light is multiplied, by uniform logarithms whose mean over the training views is 0; what is too
      bright is cut off, as a sensor does.
    """
    rng, rows = np.random.default_rng(SEED), np.flatnonzero(~is_test)
    logs = rng.uniform(-stops, stops, (len(rows), 1)) + rng.uniform(-stops / 4, stops / 4, (len(rows), 3))
    changed = images.copy()
    for row, own in zip(rows, logs - logs.mean(0), strict=True):
        changed[row] = relit(images[row], own)
    return changed


def displaced(poses: np.ndarray, is_test: np.ndarray, degrees: float, shift: float) -> np.ndarray:
    """Poses [V, 4, 4] turned about their centres by `degrees` and shifted by `shift` scene units, by training view.

    Choices: directions are random; the mean motion of the world that they amount to is taken out, to first order.
    """
    rng, rows = np.random.default_rng(SEED), np.flatnonzero(~is_test)
    turns, shifts = (rng.normal(size=(len(rows), 3)) for _ in range(2))
    turns *= np.radians(degrees) / np.linalg.norm(turns, axis=1, keepdims=True)
    shifts *= shift / np.linalg.norm(shifts, axis=1, keepdims=True)
    eyes = centers(poses[rows])
    offsets = shifts - np.cross(turns, eyes)  # x' = x + turn × x + offset
    turns, offsets = turns - turns.mean(0), offsets - offsets.mean(0)
    motions = np.tile(np.eye(4), (len(rows), 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    moved = eyes + np.cross(turns, eyes) + offsets
    motions[:, :3, 3] = moved - np.einsum("vij,vj->vi", motions[:, :3, :3], eyes)
    changed = poses.copy()
    changed[rows] = poses[rows] @ np.linalg.inv(motions)
    return changed


def disturbed(fields: dict[str, Any], colors: float, degrees: float, shift: float) -> dict[str, Any]:
    """Those fields of a capture that change, and a note of it. Poses that are None stay so."""
    changed: dict[str, Any] = {}
    is_test, notes = fields["is_test"], list(fields["source"].get("notes", []))
    if colors > 0:
        changed["images"] = recolored(np.asarray(fields["images"][:]), is_test, colors)
        notes.append(f"Exposures of the training views are disturbed by {colors:g} stops (ingest.disturb_colors).")
    if degrees > 0 or shift > 0:
        changed["cam_from_world"] = displaced(fields["cam_from_world"], is_test, degrees, shift)
        changed["tracks"] = None  # they tell of the poses as they were
        notes.append(f"Poses of the training views are disturbed by {degrees:g}° and {shift:g} scene units.")
    strengths = {"colors": colors, "degrees": degrees, "shift": shift}
    return changed | {"source": fields["source"] | {"notes": notes, "disturbed": strengths}}
