"""A finished scene, opened: render, query and select; only `export` writes a file."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from scipy.special import expit

from chebsplat.cameras import centers, upright
from chebsplat.errors import ConfigError, DataFailure
from chebsplat.formats.names import suggest
from chebsplat.formats.scene import Scene
from chebsplat.formats.semantics import Semantics
from chebsplat.formats.splats import write_splats
from chebsplat.formats.world import World
from chebsplat.labels.decode import decode_labels
from chebsplat.labels.names import lacking, rows_of
from chebsplat.render import SceneRenderer
from chebsplat.splats.gaussians import surface_of
from chebsplat.splats.rounded import rounded_light
from chebsplat.splats.similarity import Similarity
from chebsplat.stages.settings import FETCH, NAMED_LATER
from chebsplat.stages.tools.query import Query, Relevancy, understood
from chebsplat.stages.tools.up import up_of
from chebsplat.views import View

COVERED = 0.5  # least coverage of a pixel with a label


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in OpenCV's frame. K [3, 3] pixels (the centre of the first one at 0.5,
    0.5), cam_from_world [4, 4] scene units, size in pixels.
    """

    name: str
    K: np.ndarray
    cam_from_world: np.ndarray
    width: int
    height: int

    def resized(self, width: int, height: int) -> Camera:
        """The same view in another number of pixels."""
        scale = [[width / self.width], [height / self.height], [1.0]]
        return replace(self, K=self.K * scale, width=width, height=height)

    @property
    def position(self) -> np.ndarray:
        """[3], scene units."""
        position: np.ndarray = -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]
        return position

    def view(self) -> View:
        """The camera for `render.SceneRenderer`."""
        K, pose = (torch.from_numpy(matrix).float() for matrix in (self.K, self.cam_from_world))
        return View(K, pose, self.width, self.height)


@dataclass(frozen=True, eq=False)
class Picture:
    """The render of a camera. color u8 [H, W, 3]; depth f32 [H, W] along its axis, scene units, nan
    where nothing is; alpha f32 [H, W], coverage of each pixel; where there are semantics features
    f32 [H, W, C] and labels i32 [H, W], rows of `label_names`, -1 where a pixel is less than half
    covered.
    """

    color: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    features: np.ndarray | None = None
    labels: np.ndarray | None = None


class OpenedScene:
    """N Gaussians with their colours and, where there was a teacher, semantic features and labels.

    parameters: raw, as `formats.scene.Scene` holds them; `features` f32 [N, C], `labels` i32 [N]
      (-1: none) and `label_names` and `label_embeddings` f32 [L, C] are None without semantics;
      `cameras`: of the capture, in its order. Parameters are in the scene's own world; cameras,
      points, boxes, depth and files in that of its source (`world`).
    """

    def __init__(self, scene: Scene, source: Path, teacher: Path | None = None):
        self.source, self.exported, self._teacher = source, scene, teacher
        self.parameters, self.labels, self.label_names = (
            scene.parameters,
            scene.labels,
            scene.label_names,
        )
        self.label_embeddings, views = scene.label_embeddings, scene.cameras
        self.world = World.read(scene.summary)
        poses = self.world.poses_outward(views.cam_from_world)
        self.cameras = [
            Camera(name, K, pose, views.width, views.height)
            for name, K, pose in zip(views.names, views.Ks, poses, strict=True)
        ]

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def __repr__(self) -> str:
        return f"<{self.source}: {len(self):,} Gaussians, {len(self.label_names or [])} labels>"

    @property
    def features(self) -> np.ndarray | None:
        """f32 [N, C]; None without semantics."""
        return self.parameters.get("features")

    @cached_property
    def renderer(self) -> SceneRenderer:
        """Renders all Gaussians; made on first use."""
        return SceneRenderer(self.parameters, Ks=self.exported.cameras.Ks)

    def camera(self, name: str) -> Camera:
        """The capture's view of this name. Raises ConfigError, with the nearest names."""
        matches = [camera for camera in self.cameras if camera.name == name]
        if not matches:
            near = ", ".join(suggest(name, [camera.name for camera in self.cameras]))
            raise ConfigError(
                f"{self.source} has no view {name}" + (f"; near: {near}" if near else "")
            )
        return matches[0]

    def inside(self, camera: Camera) -> Camera:
        """A camera of the source's world in that of the parameters, for the `renderer`."""
        return replace(camera, cam_from_world=self.world.poses_inward(camera.cam_from_world))

    def depth(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """`SceneRenderer.render_depth` of a view inside, in the source's units."""
        depth, alpha = self.renderer.render_depth(view)
        return depth * np.float32(self.world.scale), alpha

    def render(self, camera: Camera) -> Picture:
        """Colour, depth and, where there are semantics, features and labels from `camera`."""
        view = self.inside(camera).view()
        depth, alpha = self.depth(view)
        color, features = self.renderer.render(view, with_features=True)
        if features is None or self.label_embeddings is None:
            return Picture(color, depth, alpha, features)
        labels = decode_labels(features, self.label_embeddings).astype(np.int32)
        return Picture(color, depth, alpha, features, np.where(alpha < COVERED, -1, labels))

    def query(self, text: str, against: Sequence[str] = ()) -> np.ndarray:
        """Probability or relevancy f32 [N] of each Gaussian for the words: `ask`'s scores."""
        return self.ask(text, against).scores

    def ask(self, text: str, against: Sequence[str] = ()) -> Relevancy:
        """The scene's answer to words: scores, a cut, the selection, and presence in the scene.

        Args: against: phrases to compare the words with, by LERF's relevancy; default: the
          calibration of the scene's teacher; where it has none, or the words are a phrase, LERF's
          phrases; or all other labels.
        Raises: ConfigError without semantics, or on words that the scene's teacher cannot know.
        """
        query = self.understood(text, against)
        assert self.features is not None
        return query.answer(self.features)

    def understood(self, text: str, against: Sequence[str] = ()) -> Query:
        """Words in the scene's own channels. Args and errors as of `query`."""
        if self.features is None:
            raise ConfigError(
                f"{self.source} has colours alone: no 2D teacher has said what things are; make "
                f"scene={shlex.quote(str(self.source))} set={NAMED_LATER} ({FETCH} fetches one), "
                "of a splat: chebsplat lift --capture"
            )
        if self._teacher is None:
            raise ConfigError(
                f"{self.source} has no teacher's artifact beside it; open the scene's folder"
            )
        if not text.strip():
            raise ConfigError("the query is empty; say what to look for")
        return understood(self._teacher, text.strip(), list(against))

    def select(
        self,
        mask: np.ndarray | None = None,
        *,
        label: str | Sequence[str] | None = None,
        min_opacity: float = 0.0,
        box: Sequence[float] | None = None,
    ) -> OpenedScene:
        """The Gaussians that pass every filter, as a scene; it shares no memory with this one.

        Args: mask: bool [N]; label: names to keep; min_opacity: in [0, 1]; box: x0, y0, z0, x1, y1,
          z1 of centres.
        Raises: ConfigError on an unknown label or an invalid filter; DataFailure if nothing is
          left.
        """
        names = () if label is None else (label,) if isinstance(label, str) else tuple(label)
        filters = filter_masks(self.exported, self.source, names, min_opacity, box)
        if mask is not None:
            filters["mask"] = mask = np.asarray(mask)
            if mask.shape != (len(self),) or mask.dtype != bool:
                raise ConfigError(
                    f"a mask bool [{len(self)}] is needed, not {mask.dtype} {list(mask.shape)}"
                )
        return self.part(filters)

    def part(self, filters: Mapping[str, np.ndarray]) -> OpenedScene:
        """The Gaussians that pass all filters, bool [N] by name. Raises DataFailure if none."""
        mask = np.logical_and.reduce([np.ones(len(self), bool), *filters.values()])
        if not mask.any():
            means = self.parameters["means"]
            low, high = (
                ",".join(f"{value:.4g}" for value in side) for side in (means.min(0), means.max(0))
            )
            why = ", ".join(
                f"{name} leaves out {int((~keep).sum())}" for name, keep in filters.items()
            )
            where = f"centres lie from {low} to {high}"
            raise DataFailure(
                f"no Gaussian of {len(self)} is left ({why}); {where}: choose wider filters"
            )
        parameters = {name: values[mask] for name, values in self.parameters.items()}
        part = replace(
            self.exported,
            parameters=parameters,
            order=np.argsort(np.argsort(self.exported.order[mask], kind="stable"), kind="stable"),
            labels=None if self.labels is None else self.labels[mask],
        )
        return OpenedScene(part, self.source, self._teacher)

    def semantics(self) -> Semantics | None:
        """Meanings of the Gaussians, a table that travels with a file; None without semantics."""
        if self.labels is None or self.label_names is None or self.label_embeddings is None:
            return None
        features = self.parameters["features"]
        return Semantics.of(features, self.labels, self.label_names, self.label_embeddings)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres [N, 3], f32 (f64 in another world), and colours u8 [N, 3] of SH degree 0."""
        means = self.world.outward(self.parameters["means"])
        return means, np.round(surface_of(self.parameters)[1] * 255).astype(np.uint8)

    def export(self, path: str | Path, up: np.ndarray | None = None) -> Path:
        """Write a splat as .ply, .spz, .sog or .glb, by the name's ending, with what it means where
        that is known: PLY has labels, GLB features, too, SPZ and SOG both in a file beside them.

        Args:    up: against gravity, unit [3]: the splat is turned so that up is -y, as in viewers,
          or y of a .glb; None: it stays in the capture's frame, a .glb upright by the cameras.
        Raises:  ConfigError if it exists or ends otherwise; DataFailure where SPZ cannot hold it.
        """
        path = Path(path)
        if path.exists():
            raise ConfigError(f"{path} exists; remove it, or choose another path")
        parameters, world = self.parameters, self.world
        eyes = centers(self.exported.cameras.cam_from_world)
        if up is None and path.suffix.lower() == ".glb":
            up = up_of("auto", parameters, self.exported.cameras.cam_from_world)
        if up is not None:
            turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ upright(up)
            turned = Similarity(1.0, turn, np.zeros(3))
            parameters, eyes = turned.of_gaussians(parameters), turned.of_points(eyes)
            world = World(tuple((turn @ world.origin).tolist()), world.scale)
        if path.suffix.lower() == ".spz":
            parameters = rounded_light(parameters, eyes)
        write_splats(path, parameters, self.semantics(), world)
        return path


def filter_masks(
    scene: Scene,
    path: Path,
    labels: tuple[str, ...],
    min_opacity: float,
    box: Sequence[float] | None,
) -> dict[str, np.ndarray]:
    """Masks [N] of the Gaussians that pass each filter, by name. Args, errors: see `extract`."""
    filters: dict[str, np.ndarray] = {}
    if not 0 <= min_opacity <= 1:
        raise ConfigError(f"an opacity of at least {min_opacity:g}: a number from 0 to 1 is needed")
    if box is not None and not (
        len(box) == 6 and np.isfinite(box).all() and np.less(box[:3], box[3:]).all()
    ):
        raise ConfigError(
            f"a box of {list(box)}: six numbers x0,y0,z0,x1,y1,z1 with x0 < x1 and so on are needed"
        )
    if labels:
        filters["label"] = has_label(scene, path, labels)
    if min_opacity > 0:
        filters["opacity"] = expit(scene.parameters["logit_opacities"]) >= min_opacity
    if box is not None:
        means = World.read(scene.summary).outward(scene.parameters["means"])
        filters["box"] = np.all((means >= list(box[:3])) & (means <= list(box[3:])), axis=1)
    return filters


def has_label(scene: Scene, path: Path, names: tuple[str, ...]) -> np.ndarray:
    """Mask [N] of the Gaussians with one of the names. Raises ConfigError with the nearest name."""
    if scene.labels is None or scene.label_names is None:
        why = scene.summary.get("left_out", {}).get("labels", "it has no semantics")
        raise ConfigError(f"{path} has no labels: {why}")
    for name in lacking(names, scene.label_names):
        near = suggest(name, scene.label_names, 1)
        advice = (
            f"did you mean {near[0]}?" if near else (f"there are: {', '.join(scene.label_names)}")
        )
        raise ConfigError(f"no label is called {name}; {advice}")
    return np.isin(scene.labels, rows_of(names, scene.label_names))
