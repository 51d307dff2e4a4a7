"""Cameras to render a scene from: its capture's, an orbit or path through them, or a file's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from chebsplat.cameras import centers, common_up, upright
from chebsplat.errors import ConfigError
from chebsplat.formats.images import MAX_PIXELS, MAX_SIDE
from chebsplat.stages.tools.camera_files import read_cameras
from chebsplat.stages.tools.scene import Camera, OpenedScene
from chebsplat.stages.tools.up import LEAST_SURE, Up, up_of

ROUND = 120  # frames of an orbit


def path_of(
    scene: OpenedScene, path: str, n_frames: int | None, up: Up | None = None
) -> list[Camera]:
    """`capture`: the capture's cameras; `orbit`: an orbit among them; otherwise a .json file's.

    Args:   n_frames: of the orbit (None: 120), or of a path through the cameras (None: no path);
      up: of the orbit.
    Raises: ConfigError if it is none of these, or up is given of another path than an orbit;
      InputError if the file's cameras are unusable.
    """
    if path == "orbit":
        poses = np.stack([camera.cam_from_world for camera in scene.cameras])
        return orbit(
            scene.cameras,
            n_frames or ROUND,
            None if up is None else up_of(up, scene.parameters, poses),
        )
    if up is not None:
        raise ConfigError(
            f"--up is of an orbit, and the cameras of {path} have their own; add --path orbit"
        )
    if path == "capture":
        cameras = scene.cameras
    elif path.endswith(".json"):
        cameras = read_cameras(Path(path).expanduser())
    else:
        raise ConfigError(f"--path {path}: orbit, capture or a .json of cameras is needed")
    return cameras if n_frames is None else between(cameras, n_frames)


def orbit(cameras: list[Camera], n_frames: int, up: np.ndarray | None = None) -> list[Camera]:
    """An upright orbit around the cameras' point of focus, on the ellipse that they lie on.

    Args: up: unit [3]; None: the cameras' own.
    Choices: the ellipse has the centre and the spread of the cameras in the plane across their
      common up; all frames look at the point that is nearest to the cameras' axes, in least
      squares; where axes are parallel, at the mean of what lies before the cameras at the distance
      of their spread. The lens is the first camera's.
    """
    poses = np.stack([camera.cam_from_world for camera in cameras])
    eyes, ahead = centers(poses), poses[:, 2, :3]
    if up is None:
        up, sure = common_up(poses)
        if sure < LEAST_SURE:  # rolled cameras, or all of one direction: the mean of their tops
            up = -poses[:, 1, :3].mean(0)
    turn = upright(up)
    target, middle = focus(eyes, ahead), eyes.mean(0)
    flat = (eyes - middle) @ turn[:2].T
    spread, axes = np.linalg.eigh(flat.T @ flat / len(flat))
    away = np.linalg.norm(target - middle)
    least = 0.1 * float(away) or 1.0  # also for cameras in one place or on a line
    radii = np.maximum(np.sqrt(2 * spread.clip(0)), least)
    angles = np.arange(n_frames) * (2 * np.pi / n_frames)
    round_ = np.stack([radii[0] * np.cos(angles), radii[1] * np.sin(angles)], 1) @ axes.T
    places = middle + round_ @ turn[:2]
    return [
        replace(cameras[0], name=f"orbit_{k:04d}", cam_from_world=look_at(place, target, turn[2]))
        for k, place in enumerate(places)
    ]


def between(keys: list[Camera], n_frames: int) -> list[Camera]:
    """A path through cameras of one size, `n_frames` in all, at an even pace from each to the next.

    Choices: centres and lenses lie on the piecewise cubic through the keys that does not overshoot
      (PCHIP), rotations turn by the shortest arc from key to key.
    Raises: ConfigError on fewer than two keys or frames, or keys of several sizes.
    """
    if len(keys) < 2 or n_frames < 2:
        raise ConfigError("a path through cameras needs two of them, and --frames 2 at least")
    if len({(key.width, key.height) for key in keys}) > 1:
        raise ConfigError(
            "a path needs cameras of one size; without --frames each is rendered alone"
        )
    poses, times = np.stack([camera.cam_from_world for camera in keys]), np.arange(len(keys))
    at = np.linspace(0, len(keys) - 1, n_frames)
    turns = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    eyes = PchipInterpolator(times, centers(poses))(at)
    Ks = PchipInterpolator(times, np.stack([key.K for key in keys]))(at)
    path = []
    for k in range(n_frames):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turns[k], -turns[k] @ eyes[k]
        path.append(replace(keys[0], name=f"path_{k:04d}", K=Ks[k], cam_from_world=pose))
    return path


def focus(eyes: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """The point [3] nearest to lines from `eyes` [V, 3] along unit `ahead` [V, 3]."""
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    total = across.sum(0)
    if np.linalg.eigvalsh(total)[0] < 1e-3 * len(eyes):
        reach = np.linalg.norm(eyes - eyes.mean(0), axis=1).max() or 1.0
        return np.asarray((eyes + reach * ahead).mean(0))
    return np.linalg.solve(total, np.einsum("vij,vj->i", across, eyes))


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """cam_from_world [4, 4], OpenCV's axes, of an upright camera at `eye` towards `target`."""
    forward = target - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # straight up or down
        right = upright(up)[0]
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def fitted(camera: Camera, size: tuple[int, int] | None) -> Camera:
    """The camera in `size` (width, height) with its whole view; another shape adds to the sides."""
    if size is None:
        return camera
    width, height = size
    scale = min(width / camera.width, height / camera.height)
    K = camera.K * [[scale], [scale], [1.0]]
    K[:2, 2] += 0.5 * (width - scale * camera.width), 0.5 * (height - scale * camera.height)
    return replace(camera, K=K, width=width, height=height)


def size_of(text: str | None) -> tuple[int, int] | None:
    """(width, height) of "1280x960". Raises ConfigError."""
    if text is None:
        return None
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ConfigError(f"--size {text}: WIDTHxHEIGHT in pixels is needed, such as 1280x960")
    size = int(width), int(height)
    if min(size) < 1 or max(size) > MAX_SIDE or size[0] * size[1] > MAX_PIXELS:
        raise ConfigError(
            f"--size {text}: 1 to {MAX_SIDE} pixels a side, {MAX_PIXELS // 10**6} million at most"
        )
    return size
