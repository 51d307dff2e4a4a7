"""The up direction: the user's, the cameras', or the floor's normal."""

from __future__ import annotations

import logging

import numpy as np
from scipy.special import expit

from chebsplat.cameras import common_up
from chebsplat.shape.room import LEAST_BOXED, room_up
from chebsplat.splats.gaussians import surface_of

log = logging.getLogger("chebsplat")

LEAST_SURE = 0.5  # of `cameras.common_up`, below which the cameras are not upright
LEAST_LEAN = 0.2  # of `room_up`: 26 rooms have .32 at least
Up = np.ndarray | str  # unit [3], or "auto"


def up_of(
    choice: Up, parameters: dict[str, np.ndarray], poses: np.ndarray | None = None
) -> np.ndarray:
    """The unit vector against gravity [3] of a scene of these raw parameters.

    Args: choice: the vector itself, or `auto`; poses: cam_from_world [V, 4, 4] of the views.
    Choices: `auto` is the cameras' common up where they are upright; otherwise the normal of the
      floor, on the side of the cameras' tops where these lean to one. A line of the log says which,
      or warns that neither is clear.
    """
    if not isinstance(choice, str):
        return choice
    if poses is not None and len(poses):
        up, sure = common_up(poses)
        if sure >= LEAST_SURE:
            log.info("up is %s, by the cameras (--up auto)", format_up(up))
            return up
    up, boxed, lean = measure_room(parameters)
    if poses is not None and len(poses) > 1:
        tops = float(-poses[:, 1, :3].mean(0) @ up)
        if abs(tops) > LEAST_SURE:
            up, lean = up * np.sign(tops), 1.0
    if boxed < LEAST_BOXED or lean < LEAST_LEAN:
        why = (
            "nothing in it tells up from down"
            if boxed >= LEAST_BOXED
            else f"this does not look like a room ({100 * boxed:.0f} % of its surface lies across "
            "three directions at right angles)"
        )
        log.warning("not sure which way is up: %s; %s is taken, or give --up", why, format_up(up))
        return up
    log.info("up is %s, by the floor (--up auto)", format_up(up))
    return up


def measure_room(parameters: dict[str, np.ndarray]) -> tuple[np.ndarray, float, float]:
    """`room_up` of Gaussians with these raw parameters, each weighed by its flat, opaque area."""
    scales = np.sort(np.exp(parameters["log_scales"].astype(np.float64).clip(-100, 100)), 1)
    flat = (1 - scales[:, 0] / scales[:, 1].clip(1e-30)) * scales[:, 1] * scales[:, 2]
    opacities = expit(parameters["logit_opacities"].astype(np.float64))
    weights = flat.clip(0, np.quantile(flat, 0.98)) * opacities + 1e-12
    return room_up(parameters["means"].astype(np.float64), surface_of(parameters)[0], weights)


def up_of_room(parameters: dict[str, np.ndarray]) -> np.ndarray | None:
    """Up of a splat that is clearly a room, unit [3]; None of any other."""
    up, boxed, lean = measure_room(parameters)
    if boxed < LEAST_BOXED or lean < LEAST_LEAN:
        return None
    log.info("up is %s, by the shape of the room (--up says otherwise)", format_up(up))
    return up


def format_up(up: np.ndarray) -> str:
    """Up in the form that `--up` reads."""
    return ",".join(f"{v:.3f}" for v in up)
