"""Cameras to render a scene from: a flight, an orbit, the capture's own, or a file's."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import expit

from chebsplat.cameras import centers, common_up, upright
from chebsplat.errors import ConfigError
from chebsplat.formats.images import MAX_PIXELS, MAX_SIDE
from chebsplat.stages.tools.camera_files import read_cameras
from chebsplat.stages.tools.scene import Camera, OpenedScene
from chebsplat.stages.tools.up import LEAST_SURE, Up, up_of

log = logging.getLogger("chebsplat")

ROUND = 120  # frames of an orbit
PACE, LONGEST = 0.02, 720  # of a flight: rad of turn, or as much parallax, a frame; frames
SMOOTH = 12  # frames, of the Gaussian that a flight is smoothed by
STEEPEST = np.radians(50)  # that a flight looks up or down
INWARD, WIDEST_GAP = 0.9, np.radians(120)  # of cameras that an orbit is flown among
N_DRAWN = 20_000  # points of a splat's surface, which bound free space
SECTORS, WALLED = (16, 4), 0.75  # about a place, within 60 degrees of level; share that is filled
LEAST_ROOM = 0.1  # of a room's middling side, from a place to what is nearest


def path_of(
    scene: OpenedScene, path: str, n_frames: int | None, up: Up | None = None
) -> list[Camera]:
    """`auto`: an orbit where the cameras look inwards from all around, otherwise a flight;
    `flight`: along the capture's cameras, or within the free space of a splat without a capture;
    `orbit`: among the cameras; `capture`: these themselves; otherwise those of a .json file.

    Args:   n_frames: of an orbit (None: 120) or a flight (None: by its length), or of a path
      through the other cameras (None: no path); up: of orbit and flight.
    Raises: ConfigError if it is none of these, or up is given of cameras that have their own;
      InputError if the file's cameras are unusable.
    """
    if path in ("auto", "flight", "orbit"):
        return fly(scene, path, n_frames, up)
    if up is not None:
        raise ConfigError(
            f"--up is of an orbit or a flight, and the cameras of {path} have their own; "
            "leave out --up or --path"
        )
    if path == "capture":
        cameras = scene.cameras
    elif path.endswith(".json"):
        cameras = read_cameras(Path(path).expanduser())
    else:
        raise ConfigError(
            f"--path {path}: auto, flight, orbit, capture or a .json of cameras is needed"
        )
    return cameras if n_frames is None else between(cameras, n_frames)


def fly(scene: OpenedScene, path: str, n_frames: int | None, up: Up | None) -> list[Camera]:
    """An orbit or a flight, as `path_of` says; of `auto` a line says which.

    Choices: of one camera, which a splat without a capture has, the flight goes round within a
      room's free space (`find_free_place`); where there is none it is an orbit from outside.
    """
    cameras, means = scene.cameras, scene.points()[0].astype(np.float64)
    poses = np.stack([camera.cam_from_world for camera in cameras])
    top = infer_up(poses) if up is None else up_of(up, scene.parameters, poses)
    if len(cameras) == 1:
        solid = scene.world.outward(draw_surface(scene.parameters))
        place = None if path == "orbit" else find_free_place(solid, top)
        log.info("the path goes round %s", "the splat" if place is None else "in its free space")
        return go_round(cameras[0], solid, place, n_frames or ROUND, top)
    if path == "auto":
        path = "orbit" if look_inwards(cameras, top) else "flight"
        what = "goes round what the cameras look at" if path == "orbit" else "follows the cameras"
        log.info("the path %s (--path %s)", what, path)
    if path == "orbit":
        return orbit(cameras, n_frames or ROUND, top)
    depth = float(np.median(np.linalg.norm(means - centers(poses).mean(0), axis=1)))
    return fly_along(cameras, n_frames, top, depth)


def infer_up(poses: np.ndarray) -> np.ndarray:
    """Unit [3]: the direction that upright cameras share; where they do not tell, the mean of
    their tops.
    """
    up, sure = common_up(poses)
    if sure >= LEAST_SURE:
        return up
    up = -poses[:, 1, :3].mean(0)
    length = float(np.linalg.norm(up))
    return up / length if length > 0.1 else -poses[0, 1, :3]


def look_inwards(cameras: list[Camera], up: np.ndarray) -> bool:
    """True where nine tenths of the cameras have what they look at in the picture, and they stand
    around it without a gap of more than 120 degrees.
    """
    poses = np.stack([camera.cam_from_world for camera in cameras])
    eyes = centers(poses)
    target = focus(eyes, poses[:, 2, :3])
    n_seeing = 0
    for camera in cameras:
        x, y, z = camera.K @ (camera.cam_from_world[:3] @ np.append(target, 1.0))
        n_seeing += z > 0 and 0 < x < z * camera.width and 0 < y < z * camera.height
    flat = (eyes - target) @ upright(up)[:2].T
    angles = np.sort(np.arctan2(flat[:, 1], flat[:, 0]))
    gap = np.diff(np.append(angles, angles[0] + 2 * np.pi)).max()
    return bool(n_seeing >= INWARD * len(cameras) and gap <= WIDEST_GAP)


def fly_along(
    cameras: list[Camera], n_frames: int | None, up: np.ndarray, depth: float
) -> list[Camera]:
    """A smooth flight along the cameras, each frame upright, at an even pace.

    Args: n_frames: None: by its length, from ROUND to LONGEST; up: unit [3]; depth: scene units,
      of a middling thing that is seen.
    Choices: the pace counts a turn in rad, and a way in `depth`, which move a picture alike.
      Cameras are visited as they were taken, or each time the nearest where that is shorter: photos
      in no order are a way, too. Centres and directions are smoothed by a Gaussian of SMOOTH
      frames; none looks up or down by more than 50 degrees, where a level camera would spin.
      The lens is the first camera's.
    """
    poses = np.stack([camera.cam_from_world for camera in cameras])
    marks = np.concatenate([centers(poses) / depth, poses[:, 2, :3]], 1)
    order = min(
        np.arange(len(poses)),
        order_by_nearest(marks),
        key=lambda row: measure_steps(marks, row).sum(),
    )
    lengths = measure_steps(marks, order)
    order = order[np.append(True, lengths > 1e-6)]  # of equal ones the first
    if len(order) == 1:
        return [cameras[order[0]]] * (n_frames or ROUND)
    at = np.append(0.0, lengths[lengths > 1e-6].cumsum())
    count = n_frames or int(np.clip(at[-1] / PACE, ROUND, LONGEST))
    times = np.linspace(0, at[-1], count)
    rotations = Rotation.from_matrix(poses[order][:, :3, :3])
    ahead = Slerp(at, rotations)(times).as_matrix()[:, 2]
    eyes = PchipInterpolator(at, centers(poses[order]))(times)
    eyes, ahead = (gaussian_filter1d(way, SMOOTH, axis=0, mode="nearest") for way in (eyes, ahead))
    return aim("flight", cameras[0], eyes, [level_off(way, up) for way in ahead], up)


def draw_surface(parameters: dict[str, np.ndarray]) -> np.ndarray:
    """Points [N_DRAWN, 3] of Gaussians, drawn by their area and opacity, as far from their centres
    as they reach.
    """
    scales = np.exp(parameters["log_scales"].astype(np.float64).clip(-100, 100))
    area = np.sort(scales, 1)[:, 1:].prod(1)
    opacities = expit(parameters["logit_opacities"].astype(np.float64))
    weights = area.clip(0, np.quantile(area, 0.98)) * opacities + 1e-12
    rng = np.random.default_rng(0)
    rows = rng.choice(len(scales), N_DRAWN, p=weights / weights.sum())
    turns = Rotation.from_quat(parameters["quats"][rows], scalar_first=True)
    return parameters["means"][rows] + turns.apply(scales[rows] * rng.normal(size=(N_DRAWN, 3)))


def find_free_place(solid: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float] | None:
    """The freest place within a room of opaque Gaussians at `solid` [N, 3], and the distance of the
    nearest; None where nothing surrounds a place.

    Choices: places of a grid in the middle of the box of nearly all, between a third and two
      thirds of its height; a place is within where three quarters of the sectors about it hold
      Gaussians.
    """
    turn = upright(up)
    within = solid @ turn.T
    low, high = np.quantile(within, (0.02, 0.98), axis=0)
    parts = np.linspace(0.1, 0.9, 9), np.linspace(0.1, 0.9, 9), np.linspace(0.35, 0.65, 3)
    places = low + (high - low) * np.stack(np.meshgrid(*parts), -1).reshape(-1, 3)
    clear = cKDTree(within).query(places)[0]
    for k in np.argsort(-clear):
        if clear[k] < LEAST_ROOM * np.median(high - low):
            return None
        x, y, z = (within - places[k]).T
        azimuth, height = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
        bounds = [[-np.pi, np.pi], [-np.pi / 3, np.pi / 3]]
        filled = np.histogram2d(azimuth, height, SECTORS, bounds)[0] > 0
        if filled.mean() >= WALLED:
            return places[k] @ turn, float(clear[k])
    return None


def go_round(
    lens: Camera,
    solid: np.ndarray,
    place: tuple[np.ndarray, float] | None,
    n_frames: int,
    up: np.ndarray,
) -> list[Camera]:
    """A round of a splat without a capture: about a free place and what surrounds it, each frame
    looking across it, or, without such a place, about the splat.

    Args: solid: centres [N, 3] of opaque Gaussians; place: of `find_free_place`; up: unit [3].
    Choices: within, the round has half of the free distance; outside, all but the outermost of the
      splat is in the picture.
    """
    turn = upright(up)
    angles = np.arange(n_frames) * (2 * np.pi / n_frames)
    round_ = np.stack([np.cos(angles), np.sin(angles), np.zeros(n_frames)], 1) @ turn
    if place is not None:
        middle, radius, lower = place[0], 0.5 * place[1], 0.15
    else:
        low, high = np.quantile(solid @ turn.T, (0.05, 0.95), axis=0)
        middle, lower = (low + high) / 2 @ turn, 0.3
        narrow = max(lens.width / lens.K[0, 0], lens.height / lens.K[1, 1]) / 2
        radius = (
            float((high - low).max()) / 2 / narrow + float(np.linalg.norm((high - low)[:2])) / 2
        )
    eyes = middle + radius * (round_ if place is not None else round_ + lower * turn[2])
    return aim("round", lens, eyes, -round_ - lower * turn[2], up)


def measure_steps(marks: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Lengths [V - 1] between marks [V, D] that follow each other in `order` [V]."""
    lengths: np.ndarray = np.linalg.norm(np.diff(marks[order], axis=0), axis=1)
    return lengths


def order_by_nearest(marks: np.ndarray) -> np.ndarray:
    """An order [V] of marks [V, D] from the first one, each time to the nearest of those left."""
    order, left = [0], np.arange(1, len(marks))
    while len(left):
        k = int(np.linalg.norm(marks[left] - marks[order[-1]], axis=1).argmin())
        order.append(int(left[k]))
        left = np.delete(left, k)
    return np.array(order)


def level_off(ahead: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A direction [3], raised or lowered to STEEPEST where it is steeper."""
    height = float(ahead @ up)
    flat = ahead - height * up
    length = float(np.linalg.norm(flat))
    steepest = np.tan(STEEPEST) * length
    return flat + np.clip(height, -steepest, steepest) * up if length > 0 else upright(up)[0]


def aim(
    name: str, lens: Camera, eyes: np.ndarray, aheads: Sequence[np.ndarray], up: np.ndarray
) -> list[Camera]:
    """Frames of a lens at `eyes`, each along its direction, upright."""
    return [
        replace(lens, name=f"{name}_{k:04d}", cam_from_world=look_at(eye, eye + ahead, up))
        for k, (eye, ahead) in enumerate(zip(eyes, aheads, strict=True))
    ]


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
    turn = upright(infer_up(poses) if up is None else up)
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
