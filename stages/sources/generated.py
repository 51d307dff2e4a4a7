"""The generated source: a ray-cast procedural room with exact depth and labels."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import Room
from chebsplat.synthetic.rays import Hits, RayCaster, intrinsics, walk
from chebsplat.synthetic.shuffled import build
from chebsplat.synthetic.textures import colors, dot, shade, tone_map

SIZES = {  # views, width, height
    "office": (80, 320, 240),
    "room": (80, 320, 240),
    "shuffled": (80, 320, 240),
    "toy": (16, 96, 72),
}
EDGE_SAMPLES = 3  # rays along each side of a pixel on an edge


def capture(name: str, seed: int, preset: str) -> dict[str, Any]:
    """The fields of a capture; see `formats.capture`."""
    n_views, width, height = SIZES[preset]
    room = build(preset, seed)
    caster = RayCaster(room.soup.vertices, room.soup.triangles)
    K, poses = intrinsics(width, height), walk(room.size, n_views, seed)
    with ThreadPoolExecutor(4) as pool:
        views = list(pool.map(lambda pose: photograph(room, caster, K, pose, width, height), poses))
    return {
        "names": [f"view_{k:03d}" for k in range(n_views)],
        "images": np.stack([view[0] for view in views]),
        "depth": np.stack([view[1] for view in views]),
        "labels": np.stack([view[2] for view in views]),
        "Ks": np.tile(K, (n_views, 1, 1)),
        "cam_from_world": poses,
        "class_names": list(CLASS_NAMES),
        "source": {"kind": "generated", "name": name, "preset": preset, "seed": seed, "notes": []},
    }


def photograph(
    room: Room, caster: RayCaster, K: np.ndarray, pose: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image u8 [H, W, 3], z-depth f32 [H, W] and labels i16 [H, W] of one camera.

    Choices: one ray through each pixel's centre gives depth and label; pixels on an edge of part or
      crease take their colour from EDGE_SAMPLES² rays. Textures are smooth at this resolution, so
      the others need one.
    """
    y, x = np.mgrid[:height, :width] + 0.5
    centres = np.stack([x.ravel(), y.ravel()], 1)
    hits, rays = trace(caster, K, pose, centres)
    light = shaded(room, caster, pose, rays, hits)
    image = light.reshape(height, width, 3)
    part = np.where(hits.triangle >= 0, room.soup.parts[hits.triangle], -1)
    edge = is_edge(part.reshape(height, width), hits.normals.reshape(height, width, 3))
    rows, columns = np.nonzero(edge)
    steps = (np.arange(EDGE_SAMPLES) + 0.5) / EDGE_SAMPLES
    offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    fine = (np.stack([columns, rows], 1)[:, None] + offsets[None]).reshape(-1, 2)
    if len(fine):
        fine_hits, fine_rays = trace(caster, K, pose, fine)
        fine_light = np.minimum(shaded(room, caster, pose, fine_rays, fine_hits), 1.2)
        image[rows, columns] = fine_light.reshape(len(rows), -1, 3).mean(1)

    depth = np.where(hits.triangle >= 0, hits.distance, np.nan).astype(np.float32)
    labels = np.where(hits.triangle >= 0, room.soup.labels[hits.triangle], -1).astype(np.int16)
    return tone_map(image), depth.reshape(height, width), labels.reshape(height, width)


def trace(
    caster: RayCaster, K: np.ndarray, pose: np.ndarray, pixels: np.ndarray
) -> tuple[Hits, np.ndarray]:
    """Hits of rays through pixels [N, 2], and the rays; their z is 1, so distance is z-depth."""
    camera = np.concatenate(
        [(pixels - K[:2, 2]) / (K[0, 0], K[1, 1]), np.ones((len(pixels), 1))], 1
    )
    rays = (camera @ pose[:3, :3]).astype(np.float32)
    eye = -pose[:3, :3].T @ pose[:3, 3]
    return caster.cast(eye.astype(np.float32)[None], rays), rays


def shaded(
    room: Room, caster: RayCaster, pose: np.ndarray, rays: np.ndarray, hits: Hits
) -> np.ndarray:
    """Linear light [N, 3] along rays; black where nothing is hit."""
    hit = hits.triangle >= 0
    triangle, rays, distance = hits.triangle[hit], rays[hit], hits.distance[hit]
    eye = (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)
    points = eye + rays * distance[:, None]
    to_eye = -rays / np.sqrt(dot(rays, rays))
    normals = hits.normals[hit]
    normals = normals * np.where(dot(normals, to_eye) < 0, np.float32(-1), np.float32(1))
    part, material = room.soup.parts[triangle], room.soup.materials[triangle]
    local = np.einsum("nij,nj->ni", room.soup.rotations[part], points - room.soup.origins[part])
    albedo = colors(local, material, room.materials)
    gloss = np.array([m.gloss for m in room.materials], np.float32)[material]
    shininess = np.array([m.shininess for m in room.materials], np.float32)[material]
    light = np.zeros((len(hit), 3), np.float32)
    light[hit] = shade(
        points, normals, to_eye, albedo, gloss, shininess, room.lights, caster.is_blocked
    )
    return light


def is_edge(part: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Pixels [H, W] beside another part, or beside a crease of more than about 25°."""
    edge = np.zeros(part.shape, bool)
    for axis in (0, 1):
        p, n, e = (np.moveaxis(a, axis, 0) for a in (part, normals, edge))
        differs = (p[1:] != p[:-1]) | ((n[1:] * n[:-1]).sum(-1) < 0.9)
        e[1:] |= differs
        e[:-1] |= differs
    return edge
