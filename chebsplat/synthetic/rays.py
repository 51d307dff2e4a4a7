"""A camera that walks through a room, and rays cast at its triangles: the one door to open3d."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from chebsplat.errors import ConfigError

TWO_ROUNDS = 40  # views from which on the path goes round twice


def open3d() -> Any:
    """The module, imported on first use.

    Raises: ConfigError, with the remedy, where it or a library that it is linked to is missing.
    Choices: libusb, which few machines have, is loaded first, from libusb-package: open3d's loader
      finds it by name.
    """
    with suppress(ImportError, OSError):  # the system may have one
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        remedy = (
            "pip install open3d-cpu libusb-package; Debian, Ubuntu: apt install libegl1 "
            "libgl1 libgomp1"
        )
        raise ConfigError(f"open3d cannot be imported: {error} ({remedy})") from error
    return module


class Hits(NamedTuple):
    """Of rays: distance f32 [N], inf: none; triangle i64 [N], -1: none; unit normals f32 [N, 3]."""

    distance: np.ndarray
    triangle: np.ndarray
    normals: np.ndarray


class RayCaster:
    """Casts rays at a triangle soup: vertices f32 [N, 3], triangles u32 [T, 3]."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray):
        self._open3d = open3d()
        self._scene: Any = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(vertices, np.float32), self._tensor(triangles, np.uint32)
        )
        self._none = self._scene.INVALID_ID

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """First hits of rays [N, 3] + t [N, 3]; distance is in units of the direction's length."""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        triangle = answer["primitive_ids"].numpy().astype(np.int64)
        normals = answer["primitive_normals"].numpy()
        triangle[triangle == self._none] = -1
        lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
        return Hits(answer["t_hit"].numpy(), triangle, normals / np.maximum(lengths, 1e-20))

    def is_blocked(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Bool [N]: something lies within one length of the direction."""
        blocked: np.ndarray = self._scene.test_occlusions(
            self._rays(origins, directions), 0.0, 1.0
        ).numpy()
        return blocked

    def _rays(self, origins: np.ndarray, directions: np.ndarray) -> Any:
        return self._tensor(
            np.concatenate(np.broadcast_arrays(origins, directions), -1), np.float32
        )

    def _tensor(self, array: np.ndarray, dtype: Any) -> Any:
        return self._open3d.core.Tensor(np.ascontiguousarray(array, dtype))


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """cam_from_world [4, 4] of a camera at `eye` looking at `target`, OpenCV axes, world z up."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose


def walk(size: tuple[float, float, float], n_views: int, seed: int) -> np.ndarray:
    """Poses [V, 4, 4] cam_from_world along the path.

    Choices: two rounds, the second lower, closer and turned the other way; the gaze crosses the
      room, swings by ±49° and nods twice a round between 26° down and 4° up, so every surface is
      seen from several sides. Few views make one round with half the swing and one nod: neighbours
      would share too little otherwise. No eye is below 1.47 m, which clears the chairs (1.05 m at
      most) by 0.4 m; what is taller stands at a wall. In 200 shuffled rooms nothing comes nearer
      than 0.38 m.
    """
    rng = np.random.default_rng([seed, 1])
    phase = rng.uniform(0, 2 * np.pi)
    width, depth, _ = size
    rounds, swing = (2, 0.85) if n_views >= TWO_ROUNDS else (1, 0.4)
    poses = []
    for k in range(n_views):
        t = rounds * k / n_views
        round_, angle = int(t), 2 * np.pi * t + phase
        radius = (0.27, 0.25) if round_ == 0 else (0.20, 0.17)
        height = (1.62 if round_ == 0 else 1.52) + 0.05 * np.sin(3 * angle)
        eye = np.array(
            [
                width * (0.5 + radius[0] * np.cos(angle)),
                depth * (0.5 + radius[1] * np.sin(angle)),
                height,
            ]
        )
        gaze = angle + np.pi + (swing if round_ == 0 else -swing) * np.sin(angle + phase)
        pitch = np.deg2rad(-11 + 15 * np.sin(rounds * angle))
        direction = np.array(
            [np.cos(gaze) * np.cos(pitch), np.sin(gaze) * np.cos(pitch), np.sin(pitch)]
        )
        poses.append(look_at(eye, eye + direction))
    return np.stack(poses)


def intrinsics(width: int, height: int, fov_x: float = 72.0) -> np.ndarray:
    """K [3, 3] of a centred pinhole; fov_x in degrees."""
    focal = 0.5 * width / np.tan(np.deg2rad(fov_x) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
