"""Rays cast at triangles: the one door to open3d."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Hits(NamedTuple):
    """distance f32 [N] along the ray (inf: none), triangle i64 [N] (-1: none), normals f32 [N, 3] of unit length."""

    distance: np.ndarray
    triangle: np.ndarray
    normals: np.ndarray


class RayCaster:
    """Casts rays at a triangle soup: vertices f32 [N, 3], triangles u32 [T, 3]."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray):
        import open3d as o3d

        self._open3d: Any = o3d
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(vertices, np.float32), self._tensor(triangles, np.uint32))
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
        blocked: np.ndarray = self._scene.test_occlusions(self._rays(origins, directions), 0.0, 1.0).numpy()
        return blocked

    def _rays(self, origins: np.ndarray, directions: np.ndarray) -> Any:
        return self._tensor(np.concatenate(np.broadcast_arrays(origins, directions), -1), np.float32)

    def _tensor(self, array: np.ndarray, dtype: Any) -> Any:
        return self._open3d.core.Tensor(np.ascontiguousarray(array, dtype))
