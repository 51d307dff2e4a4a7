"""`capture/2`: images and cameras; depth, labels and loss masks where the source has them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.cameras import check_cameras
from chebsplat.formats.names import check_names
from chebsplat.formats.record import Array, Record, Stack

PIXELS = ("view", "row", "column")
MAPS = ("depth", "labels", "pseudo_labels", "confidence", "loss_mask")


@dataclass
class Capture(Record):
    """V views of one size H x W.

    names:          unique per view; every join between artifacts is on these, never on position.
    images:         u8 [V, H, W, 3].
    Ks:             f64 [V, 3, 3] pixels, pixel centres at half integers (COLMAP).
    cam_from_world: f64 [V, 4, 4] OpenCV axes, or None where poses are unknown.
    is_test:        bool [V]; test views are never trained on.
    depth, labels, pseudo_labels, confidence, loss_mask: of each pixel, or None. class_names[labels]
      names a pixel.
    points:         f32 [N, 3] in the world, where the source has points; point_colors u8 [N, 3] and
      tracks i32 [T, 2] (point, view that observes it), or None.
    taken:          u8 [T, H', W', 3], originals (at most 1600 pixels) of test photos that `images`
      has undistorted or reduced, or None; lenses: of each the view's name, COLMAP's model and
      parameters, width and height.
    source:         which source, and notes about what was dropped or changed; protocol: name and
      parameters.
    """

    SCHEMA: ClassVar[str] = "chebsplat.capture/2"
    names: list[str]
    images: Annotated[Stack, Array("uint8", (*PIXELS, 3), "sRGB", by_view=True)]
    Ks: Annotated[np.ndarray, Array("float64", ("view", 3, 3), "pixels")]
    cam_from_world: Annotated[np.ndarray | None, Array("float64", ("view", 4, 4), "scene units")]
    is_test: Annotated[np.ndarray, Array("bool", ("view",))]
    depth: Annotated[
        Stack | None,
        Array("float32", PIXELS, "scene units, z; nan unknown", by_view=True, any_value=True),
    ] = None
    labels: Annotated[
        Stack | None, Array("int16", PIXELS, "class index, -1 ignored", by_view=True)
    ] = None
    loss_mask: Annotated[
        Stack | None, Array("bool", PIXELS, "true where a pixel counts", by_view=True)
    ] = None
    class_names: list[str] | None = None
    source: dict[str, Any] = field(default_factory=dict)
    protocol: dict[str, Any] = field(default_factory=dict)
    points: Annotated[np.ndarray | None, Array("float32", ("point", 3), "scene units")] = None
    point_colors: Annotated[np.ndarray | None, Array("uint8", ("point", 3), "sRGB")] = None
    pseudo_labels: Annotated[
        Stack | None,
        Array("int16", PIXELS, "class index that a 2D network gave, -1 none", by_view=True),
    ] = None
    confidence: Annotated[
        Stack | None, Array("float16", PIXELS, "of the pseudo labels, 0 to 1", by_view=True)
    ] = None
    tracks: Annotated[
        np.ndarray | None, Array("int32", ("observation", 2), "index of a point, of a view")
    ] = None
    taken: Annotated[
        Stack | None, Array("uint8", ("photo", "its row", "its column", 3), "sRGB", by_view=True)
    ] = None
    lenses: list[list[Any]] = field(default_factory=list)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.images.shape[2], self.images.shape[1]

    def write(self, out: Path) -> None:
        """Fill the directory of `artifact.publish`. Raises InputError where views disagree."""
        _check(self)
        super().write(out)


def _check(capture: Capture) -> None:
    where, remedy = "capture", "correct the source"
    n_views, points, tracks = len(capture.names), capture.points, capture.tracks
    check_names(capture.names, "view names", where, remedy)
    if capture.class_names is not None:
        check_names(capture.class_names, "class names", where, remedy)
    if len(capture.images) != n_views:
        raise InputError(f"{where}: {len(capture.images)} images for {n_views} views; {remedy}")
    if (
        capture.labels is not None or capture.pseudo_labels is not None
    ) and not capture.class_names:
        raise InputError(
            f"{where}: labels without class names; name them in scene.json or labels.json"
        )
    check_cameras(capture.names, capture.Ks, capture.cam_from_world, where, remedy)
    if points is None or tracks is None or not len(tracks):
        return
    if tracks.min() < 0 or (tracks.max(0) >= (len(points), n_views)).any():
        raise InputError(f"{where}: tracks of points or views that are not there; {remedy}")
