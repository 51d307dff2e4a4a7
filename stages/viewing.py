"""What a viewer shows of a scene for a state of its controls: pictures, labels under their pixels, what a click takes.

Pictures come from the renderer that `evaluate` measures; none of this knows a browser.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from chebsplat.errors import ConfigError
from chebsplat.stages.opened import COVERED, Camera, OpenedScene

if TYPE_CHECKING:
    from chebsplat.render import SceneRenderer
    from chebsplat.stages.query import Query

MODES = ("color", "labels", "relevancy", "depth", "density", "error")
SEMANTIC = ("labels", "relevancy")
SELECTED = np.array([255, 140, 0], np.float32)  # the colour that a selection is mixed with
NEIGHBORS = 8  # of the density of Gaussians


@dataclass(frozen=True, eq=False)
class Shown:
    """The controls of a viewer. mode: of MODES; hidden: labels left out; min_opacity in [0, 1]; sh_degree: the highest
    in use; box: x0, y0, z0, x1, y1, z1 of centres, scene units; query: where the mode is relevancy; selected: bool [N].
    """

    mode: str = "color"
    hidden: frozenset[int] = frozenset()
    min_opacity: float = 0.0
    sh_degree: int = 3
    box: tuple[float, ...] | None = None
    query: Query | None = None
    selected: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Touched:
    """A click: the label under it, the place [3] on the surface, scene units, and the Gaussians taken, bool [N]."""

    label: int
    place: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True, eq=False)
class Beneath:
    """What is under each pixel: labels i32 [H, W], rows of `label_names`, -1 where nothing is; their probability f32
    [H, W].
    """

    labels: np.ndarray
    probability: np.ndarray


class Viewing:
    """Pictures of one scene; `photo` gives a view's photo u8 [H, W, 3] by name, or None where there is none."""

    def __init__(self, scene: OpenedScene, photo: Callable[[str], np.ndarray | None] | None = None):
        self.scene, self.photo = scene, photo
        self._held: tuple[object, SceneRenderer, np.ndarray] | None = None

    @property
    def modes(self) -> list[str]:
        """Those that this scene has."""
        left_out = (() if self.scene.labels is not None else SEMANTIC) + (() if self.photo else ("error",))
        return [mode for mode in MODES if mode not in left_out]

    @cached_property
    def density(self) -> np.ndarray:
        """log10 of Gaussians per area f32 [N], scene units^-2: 8 neighbours within the circle that holds them, since
        Gaussians lie on surfaces.
        """
        from scipy.spatial import cKDTree

        means = self.scene.parameters["means"].astype(np.float64)
        k = min(NEIGHBORS, len(means) - 1)
        if k < 1:
            return np.zeros(len(means), np.float32)
        radii = cKDTree(means).query(means, k=[k + 1])[0][:, 0]
        return np.log10(k / (np.pi * radii.clip(1e-9) ** 2)).astype(np.float32)

    @cached_property
    def density_range(self) -> tuple[float, float]:
        """The densities, log10, of the darkest and the brightest colour: 2 % and 98 % of all."""
        low, high = np.quantile(self.density, (0.02, 0.98))
        return float(low), max(float(high), float(low) + 1e-6)

    @cached_property
    def far(self) -> float:
        """Scene units at which depth is darkest: the diagonal of the box of 90 % of the centres by each axis."""
        low, high = np.quantile(self.scene.parameters["means"].astype(np.float64), (0.05, 0.95), axis=0)
        return max(float(np.linalg.norm(high - low)), 1e-6)

    def kept(self, shown: Shown) -> np.ndarray:
        """Rows of the Gaussians that the controls leave, i64 [M], ascending."""
        keep = np.ones(len(self.scene), bool)
        if shown.min_opacity > 0 or shown.box is not None:
            from chebsplat.stages.extract import passing  # which imports what takes a second

            filters = passing(self.scene.exported, self.scene.source, (), shown.min_opacity, shown.box)
            keep = np.logical_and.reduce([keep, *filters.values()])
        if shown.hidden and self.scene.labels is not None:
            keep &= ~np.isin(self.scene.labels, list(shown.hidden))
        return np.flatnonzero(keep)

    def renderer(self, shown: Shown) -> tuple[SceneRenderer, np.ndarray]:
        """A renderer of what the controls leave, and the rows [M] of these Gaussians; the last one is kept."""
        from chebsplat.render import SceneRenderer

        key = shown.hidden, shown.min_opacity, shown.sh_degree, shown.box
        if self._held is None or self._held[0] != key:
            rows = self.kept(shown)
            if len(rows) == len(self.scene) and shown.sh_degree >= self.scene.parameters["degrees"].max():
                made = self.scene.renderer
            else:
                part = {name: values[rows] for name, values in self.scene.parameters.items()}
                part["degrees"] = np.minimum(part["degrees"], shown.sh_degree).astype(np.uint8)
                made = SceneRenderer(part)
            self._held = key, made, rows
        return self._held[1], self._held[2]

    def picture(self, camera: Camera, shown: Shown) -> np.ndarray:
        """u8 [H, W, 3] of the camera.

        Raises: ConfigError where the mode needs what is not there: semantics, a query, a photo of this very view.
        """
        from chebsplat.stages.frames import depth_colors
        from chebsplat.stages.pages.pictures import colored, heat

        if shown.mode not in self.modes:
            raise ConfigError(f"{self.scene.source} has no {shown.mode}; there are {', '.join(self.modes)}")
        renderer, rows = self.renderer(shown)
        if not len(rows):
            return np.zeros((camera.height, camera.width, 3), np.uint8)
        view, names = camera.view(), self.scene.label_names or []
        if shown.mode == "labels":
            image = colored(self.beneath(camera, shown).labels, len(names))
        elif shown.mode == "relevancy":
            if shown.query is None:
                raise ConfigError("relevancy is of words; ask for some")
            color, features = renderer.render(view, with_features=True)
            assert features is not None
            image = heat(color, shown.query.scores(features))
        elif shown.mode == "depth":
            image = depth_colors(renderer.render_depth(view)[0], self.far)
        elif shown.mode == "density":
            image = self._density_picture(renderer, rows, camera)
        elif shown.mode == "error":
            image = self._error_picture(renderer, camera)
        else:
            image = renderer.render(view)[0]
        return image if shown.selected is None else brought_out(image, rendered(renderer, shown.selected[rows], camera))

    def _density_picture(self, renderer: SceneRenderer, rows: np.ndarray, camera: Camera) -> np.ndarray:
        from matplotlib import colormaps

        low, high = self.density_range
        share = ((self.density[rows] - low) / (high - low)).clip(0, 1)
        found = rendered(renderer, np.stack([share, np.ones_like(share)], 1), camera)
        mean = found[..., 0] / found[..., 1].clip(1e-6)
        colors = np.round(255 * colormaps["viridis"](mean.clip(0, 1))[..., :3]).astype(np.uint8)
        return np.where(found[..., 1:] < COVERED, np.uint8(0), colors)

    def _error_picture(self, renderer: SceneRenderer, camera: Camera) -> np.ndarray:
        from chebsplat.stages.pages.pictures import error_map

        photo = None if self.photo is None else self.photo(camera.name)
        if photo is None or photo.shape[:2] != (camera.height, camera.width):
            raise ConfigError("an error is against a photo; jump to a view of the capture")
        return error_map(renderer.render(camera.view())[0], photo)

    def psnr(self, camera: Camera, shown: Shown) -> float | None:
        """Against the photo of this very view, dB; None where there is none."""
        photo = None if self.photo is None else self.photo(camera.name)
        if photo is None or photo.shape[:2] != (camera.height, camera.width):
            return None
        error = np.mean((self.picture(camera, replace(shown, mode="color", selected=None)).astype(float) - photo) ** 2)
        return float(10 * np.log10(255**2 / max(error, 1e-12)))

    def beneath(self, camera: Camera, shown: Shown) -> Beneath:
        """Labels, as `evaluate` decodes them, and their probability. Raises ConfigError without semantics."""
        from chebsplat.labels.decode import decode

        held, embeddings = self.scene.features, self.scene.label_embeddings
        if held is None or embeddings is None:
            raise ConfigError(f"{self.scene.source} has no semantics")
        renderer, rows = self.renderer(shown)
        found = rendered(renderer, np.concatenate([held[rows], np.ones((len(rows), 1), np.float32)], 1), camera)
        labels, probability = decode(found[..., :-1], embeddings)
        covered = found[..., -1] >= COVERED
        return Beneath(np.where(covered, labels, -1).astype(np.int32), np.where(covered, probability, 0))

    def touched(self, camera: Camera, shown: Shown, x: int, y: int) -> Touched | None:
        """What a click on pixel (x, y) takes: its label, and the Gaussians of that label that are connected.

        Returns: None where nothing is under the pixel, or no Gaussian bears its label.
        Choices: the click's Gaussian is the nearest of the pixel's label to the surface under it.
        """
        from chebsplat.splats.parts import connected_to

        if self.scene.labels is None:
            return None
        pixel = pixel_of(camera, x, y)
        label = int(self.beneath(pixel, shown).labels[0, 0])
        renderer, rows = self.renderer(shown)
        depth = renderer.render_depth(pixel.view())[0][0, 0]
        among = np.zeros(len(self.scene), bool)
        among[rows] = self.scene.labels[rows] == label
        if label < 0 or not np.isfinite(depth) or not among.any():
            return None
        ray = np.linalg.solve(camera.K, [x + 0.5, y + 0.5, 1.0])
        place = camera.position + camera.cam_from_world[:3, :3].T @ (depth * ray)
        means = self.scene.parameters["means"]
        away = np.where(among, np.linalg.norm(means - place, axis=1), np.inf)
        scales = np.exp(self.scene.parameters["log_scales"])
        return Touched(label, place, connected_to(int(away.argmin()), means, scales, among))


def pixel_of(camera: Camera, x: int, y: int) -> Camera:
    """The camera of one pixel of another: what it renders is that pixel."""
    K = camera.K.copy()
    K[:2, 2] -= x, y
    return replace(camera, K=K, width=1, height=1)


def padded(image: np.ndarray, aspect: float) -> np.ndarray:
    """An image u8 [H, W, 3] in the middle of a black one of another aspect, width by height, of the same pixels."""
    height, width = image.shape[:2]
    wide, high = max(width, round(height * aspect)), max(height, round(width / aspect))
    left, top = (wide - width) // 2, (high - height) // 2
    return np.pad(image, ((top, high - height - top), (left, wide - width - left), (0, 0)))


def rendered(renderer: SceneRenderer, values: np.ndarray, camera: Camera) -> np.ndarray:
    """Values [M] or [M, K] of a renderer's Gaussians, blended as its colours are: f32 [H, W, K]."""
    import torch

    carrying = copy(renderer)
    columns = np.ascontiguousarray(values.reshape(len(values), -1), np.float32)
    carrying.raw = renderer.raw | {"features": torch.from_numpy(columns)}
    found = carrying.render(camera.view(), with_features=True)[1]
    assert found is not None
    return found


def brought_out(image: np.ndarray, share: np.ndarray) -> np.ndarray:
    """An image u8 [H, W, 3] in which what is selected stands out: mixed with SELECTED by its share [H, W, 1]."""
    mixed = (0.6 + 0.4 * share) * image
    return np.round(mixed + 0.45 * share * (SELECTED - mixed)).clip(0, 255).astype(np.uint8)


def coded(beneath: Beneath) -> np.ndarray:
    """For a page: u8 [H, W, 3] of label + 1 in two bytes, low first, and the probability in 255ths."""
    codes = (beneath.labels + 1).astype(np.int64)
    return np.stack([codes & 255, codes >> 8, np.round(255 * beneath.probability)], -1).astype(np.uint8)
