"""Cameras and poses of a source, checked for being possible."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.images import MAX_PIXELS, MAX_SIDE
from chebsplat.formats.world import World
from chebsplat.stages.sources.texts import number

# COLMAP's models in the order of their ids: number of parameters
MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4, "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}  # fmt: skip
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
EQUIRECTANGULAR = "EQUIRECTANGULAR"  # of a photo of all directions
DISTORTED = tuple(name for name in MODELS if name not in PINHOLES)
# degrees to the right
FACES = {"right-front": 45.0, "right-back": 135.0, "left-back": 225.0, "left-front": 315.0}
TALL = 1.5  # heights of a face in its width: it sees 45° to either side, and 56° up and down
# of RᵀR − I: rows written with three decimals pass, a scale of 1 % does not
ROTATION_TOLERANCE = 1e-2
FOCAL = (0.01, 100.0)  # of the longer side: fields of view of 178 and of 0.6 degrees
OFF_CENTRE = 1.5  # sides by which a principal point may lie off the middle: crops have it outside
# pixels: a lens that moves none by more is not undone, which would cost detail and gain nothing
LEAST_BENT = 0.05
LEAST_KEPT = 0.25  # of each side, that a lens's distortion must leave of a photo
# difference in aspect ratio that still counts as another resolution of the same picture
SAME_SHAPE = 0.02
FARTHEST = 1e9  # scene units from the origin: in float64, points that far out are 1e-7 apart
# units of `formats.world`, between a camera and most others: float32's spacing is 0.06 there
WIDEST = 1e6


@dataclass(frozen=True)
class Camera:
    """A COLMAP camera: model, parameters in pixels with pixel centres at half integers, image size.

    turn: of a face of a photo of all directions, degrees to the right.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int
    turn: float = 0.0

    @property
    def turned(self) -> np.ndarray:
        """Rotation [3, 3] from the view to its photo."""
        sine, cosine = np.sin(np.radians(self.turn)), np.cos(np.radians(self.turn))
        return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy."""
        if self.model == EQUIRECTANGULAR:
            pixels = self.width / (2 * np.pi)  # a radian
            return pixels, pixels, self.width / 2, self.height / 2
        p, one = self.params, self.model.startswith(("SIMPLE_", "RADIAL"))
        return (p[0], p[0], p[1], p[2]) if one else (p[0], p[1], p[2], p[3])

    @property
    def colmap(self) -> Any:
        import pycolmap

        return pycolmap.Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.params)
        )


def camera_of(origin: Path, model: str, params: Any, width: Any, height: Any) -> Camera:
    """A valid camera. Raises InputError naming the file that describes it."""
    if model not in PINHOLES and model not in DISTORTED:
        raise InputError(
            f"{origin}: camera model {model} is not supported "
            f"({', '.join([*PINHOLES, *DISTORTED])} are); make perspective images first, for "
            "example with `colmap image_undistorter`"
        )
    try:
        camera = Camera(
            model, tuple(number(v) for v in params), int(number(width)), int(number(height))
        )
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{origin}: camera size or parameters are no numbers ({error}); restore the file"
        ) from None
    if wrong := fault(camera):
        raise InputError(
            f"{origin}: camera {model} {camera.width}x{camera.height} {camera.params} is not "
            f"usable: {wrong}; restore the file"
        )
    if camera.model in DISTORTED and bend(camera) < LEAST_BENT:
        return Camera("PINHOLE", camera.pinhole, camera.width, camera.height)
    return camera


@functools.lru_cache(64)
def bend(camera: Camera) -> float:
    """Largest distortion of a camera, pixels, on a grid over the photo; inf where undefined."""
    fx, fy, cx, cy = camera.pinhole
    x, y = np.meshgrid(np.linspace(0, camera.width, 33), np.linspace(0, camera.height, 33))
    pixels = np.stack([x, y], -1).reshape(-1, 2)
    rays = np.column_stack([(pixels - [cx, cy]) / [fx, fy], np.ones(len(pixels))])
    return float(
        np.nan_to_num(
            np.abs(np.asarray(camera.colmap.img_from_cam(rays), float) - pixels), nan=np.inf
        ).max()
    )


def fault(camera: Camera) -> str:
    """Fault of a camera in words; "" of a valid one."""
    width, height = camera.width, camera.height
    if len(camera.params) != MODELS[camera.model]:
        return f"{len(camera.params)} parameters"
    if min(width, height) < 1 or max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        return (
            f"a photo has 1 to {MAX_SIDE} pixels a side and at most {MAX_PIXELS // 10**6} million"
        )
    fx, fy, cx, cy = camera.pinhole
    least, most = (share * max(width, height) for share in FOCAL)
    if not (least <= min(fx, fy) and max(fx, fy) <= most):
        return f"its focal length lies outside {least:g} to {most:g} pixels"
    if abs(cx / width - 0.5) > OFF_CENTRE or abs(cy / height - 0.5) > OFF_CENTRE:
        return "its principal point lies far outside the image"
    if camera.model in DISTORTED:
        try:
            plain = undistorted(camera)
        except (ValueError, RuntimeError) as error:
            return f"its distortion cannot be undone ({error})"
        if plain.width < LEAST_KEPT * width or plain.height < LEAST_KEPT * height:
            return f"its distortion leaves {plain.width}x{plain.height} pixels"
    return ""


def scaled(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera of a photo that was resized to (width, height) `size` after calibration.

    Choices: unchanged where the photo has the camera's size, either way up, or another shape.
    """
    if (camera.width, camera.height) in (size, size[::-1]):
        return camera
    for width, height in (size, size[::-1]):
        if abs(width * camera.height / (height * camera.width) - 1) < SAME_SHAPE:
            rescaled = camera.colmap
            rescaled.rescale(width, height)
            return replace(
                camera, params=tuple(float(v) for v in rescaled.params), width=width, height=height
            )
    return camera


@functools.lru_cache(64)
def undistorted(camera: Camera) -> Camera:
    """The pinhole camera of the largest view without blank pixels; pinhole cameras as they are.

    Choices: focal lengths stay, and the principal point moves by whole pixels, so that where the
      lens bends little the view's pixels are the photo's.
    """
    if camera.model not in DISTORTED:
        return Camera("PINHOLE", camera.pinhole, camera.width, camera.height)
    if camera.model == EQUIRECTANGULAR:
        focal = camera.pinhole[0]
        width, height = round(2 * focal), round(2 * focal * TALL)
        return Camera("PINHOLE", (focal, focal, width / 2, height / 2), width, height)
    import pycolmap

    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0
    plain = pycolmap.undistort_camera(options, camera.colmap)
    fx, fy, *centre = plain.params
    centre = [own + round(cut - own) for own, cut in zip(camera.pinhole[2:], centre, strict=True)]
    return Camera("PINHOLE", (fx, fy, *centre), plain.width, plain.height)


def cam_from_world(origin: Path, world_from_cam: np.ndarray, names: list[str]) -> np.ndarray:
    """Inverses [V, 4, 4] of rigid camera-to-world matrices [V, 4, 4]; nan of those not finite.

    Raises:  InputError naming the first frame whose matrix is not rigid, or far away.
    Choices: the rounding of a text file is removed by taking the nearest rotation (SVD).
    """
    usable = np.isfinite(world_from_cam).all((1, 2))
    rotations = np.where(usable[:, None, None], world_from_cam[:, :3, :3], np.eye(3))
    # of entries like 1e300, which no rotation has
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max((1, 2))
        last = np.abs(world_from_cam[:, 3] - [0, 0, 0, 1]).max(1, where=usable[:, None], initial=0)
        rigid = (
            (error < ROTATION_TOLERANCE)
            & (np.linalg.det(rotations) > 0)
            & (last < ROTATION_TOLERANCE)
        )
    if not rigid.all():
        raise InputError(
            f"{origin}: the pose of {names[int(np.argmin(rigid))]} is not a rotation and a "
            "translation; write poses without scale, shear or mirroring"
        )
    near(origin, world_from_cam[:, :3, 3], names)
    left, _, right = np.linalg.svd(rotations)
    inverse = (left @ right).transpose(0, 2, 1)
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3] = inverse
    poses[usable, :3, 3] = -np.einsum(
        "vij,vj->vi", inverse, np.nan_to_num(world_from_cam[:, :3, 3])
    )[usable]
    poses[~usable] = np.nan
    return poses


def near(origin: Path, places: np.ndarray, names: list[str]) -> None:
    """Raise InputError if a camera's centre, of [V, 3], is beyond FARTHEST, or beyond WIDEST from
    most others; nan is left to `assembly.choose_frames`.
    """
    reach, inside = (
        np.abs(where).max(1, initial=0) for where in (places, World.of(places).inward(places))
    )
    for k in np.flatnonzero(np.isfinite(reach) & ((reach > FARTHEST) | (inside > WIDEST))):
        raise InputError(
            f"{origin}: {names[k]} lies {reach[k]:.3g} units from the origin, too far to be told "
            "from the others or to be seen beside them; correct its pose, or move the scene's "
            "origin into the scene"
        )
