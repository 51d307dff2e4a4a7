"""Rooms to train the point encoder on: points, shape, features of a 2D teacher or the truth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from chebsplat.cameras import centers, unproject
from chebsplat.formats.files import atomic_path
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.lifting.averages import SWEPT_WITHIN, averaged
from chebsplat.lifting.surface import Surface, swept_surface
from chebsplat.shape.point_inputs import PointInputs, point_inputs
from chebsplat.splats.gaussians import local_shape
from chebsplat.stages.reconstruction.dense import SIDE, depth_of_photos, reduced
from chebsplat.stages.reconstruction.thinning import thin
from chebsplat.stages.settings import TeachSection
from chebsplat.stages.shape_models.answers import units
from chebsplat.stages.sources.generated import photograph
from chebsplat.stages.teacher_models.image_encoder import TeacherInference
from chebsplat.stages.teacher_models.text_encoder import text_embeddings
from chebsplat.synthetic import CLASS_NAMES, layout
from chebsplat.synthetic.catalogue import FOLDER
from chebsplat.synthetic.furnished import Catalogue, furnished
from chebsplat.synthetic.layout import KNOWLEDGE, MODELLED
from chebsplat.synthetic.rays import RayCaster, intrinsics, walk
from chebsplat.synthetic.shuffled import jitter, shuffled

KINDS = (  # in turn by seed
    "shuffled",
    "jittered office",
    "shuffled",
    "room",
    "shuffled",
    "jittered room",
    "shuffled",
    "office",
)
FEW_VIEWS = (3, 15)  # of the photos of a room that is half seen
LEAST_SWEPT = 10  # photos of a room whose depth is swept, at least
STRETCH = (0.85, 1.2)  # of a room of other proportions, along each axis
WIDTH, HEIGHT = 320, 240
DENSITY = (0.62, 1.38)  # of the setting's number of points: scenes differ
N_NEIGHBORS = 16  # that give a point its normal and covariance


class Room(NamedTuple):
    """Inputs of N points, mean unit features [N, d], numbers of views [N], labels [N], -1 none."""

    inputs: PointInputs
    features: np.ndarray
    n_views: np.ndarray
    labels: np.ndarray


def rooms_of(
    seed: int, settings: TeachSection, network: TeacherInference, matrix: np.ndarray
) -> list[Room]:
    """Four versions of a room: by depth, with worn points (`worn`), by the depth of few photos, and
    by a sweep of photos (`swept`); with the teacher's features, or, of modelled rooms,
    the embeddings of the true labels.

    Args: seed: of `synthetic.layout.KNOWLEDGE` or `MODELLED`; matrix [C, d]: from the teacher's
      channels to those of scenes.
    Raises: ValueError on another seed.
    Choices: labels of generated rooms serve for measuring alone. Worn points have the features of
      the places that they were moved from; points of few photos, and of a sweep, those of all
      photos. Every other room of few photos is stretched, too, as proportions of worlds differ.
      Where the sweep finds nothing, the version by depth comes once more.
    """
    if seed not in KNOWLEDGE and seed not in MODELLED:
        raise ValueError(f"seed {seed} is not one for knowledge: {KNOWLEDGE}, {MODELLED}")
    images, depth, labels, K, poses = photographed(seed, settings.n_views)
    if seed in KNOWLEDGE:
        grid, _ = network.grid(images[0], 4)
        views = (network.features(image, grid, (1.0,), False, f"room {seed}") for image in images)
        return versions(
            seed, settings, images, depth, labels, [v @ matrix for v in views], K, poses
        )
    blank = [np.ones((HEIGHT // 4, WIDTH // 4, 1), np.float32)] * len(images)
    embeddings = units(text_embeddings(list(CLASS_NAMES), network.teacher) @ matrix)
    rooms = versions(seed, settings, images, depth, labels, blank, K, poses)
    return [by_truth(room, embeddings.astype(np.float32)) for room in rooms]


def by_truth(room: Room, embeddings: np.ndarray) -> Room:
    """A room with the embeddings [L, d] of its true labels; a point without one counts as not
    visible.
    """
    n_views = np.where(room.labels < 0, 0, room.n_views)
    return room._replace(features=embeddings[room.labels.clip(0)], n_views=n_views)


def versions(
    seed: int,
    settings: TeachSection,
    images: np.ndarray,
    depth: np.ndarray,
    labels: np.ndarray,
    features: Sequence[np.ndarray],
    K: np.ndarray,
    poses: np.ndarray,
) -> list[Room]:
    """The four versions of a room, by its photos and the features [h, w, d] of each."""
    rng, Ks, d = (
        np.random.default_rng([seed, 4]),
        np.tile(K, (len(poses), 1, 1)),
        features[0].shape[-1],
    )
    count = round(settings.n_points * rng.uniform(*DENSITY))
    means, eyes, named = surface(depth, labels, K, poses, count, rng)
    clean = described(means, eyes)
    mean, n_views = averaged(means, depth, features, d, Ks, poses)
    moved, rows, adrift = worn(means, clean.normals, rng)
    n_views_worn = np.where(adrift, 0, n_views[rows])
    rooms = [
        Room(clean, mean, n_views, named),
        Room(described(moved, eyes[rows]), mean[rows], n_views_worn, named[rows]),
    ]
    few = np.sort(rng.permutation(len(poses))[: int(np.exp(rng.uniform(*np.log(FEW_VIEWS))))])
    some, lookers, called = surface(depth[few], labels[few], K, poses[few], count, rng)
    mean, n_views = averaged(some, depth, features, d, Ks, poses)
    stretch = rng.uniform(*STRETCH, 3) if rng.random() < 0.5 else np.ones(3)
    rooms.append(Room(described(some * stretch, lookers * stretch), mean, n_views, called))
    sweep = swept(images, depth, K, poses, rng)
    if len(sweep.means) <= N_NEIGHBORS:
        return [*rooms, rooms[0]]
    mean, n_views = averaged(sweep.means, depth, features, d, Ks, poses, SWEPT_WITHIN)
    _, nearest = cKDTree(means).query(sweep.means)
    return [*rooms, Room(described(*sweep), mean, n_views, named[nearest])]


def described(means: np.ndarray, eyes: np.ndarray) -> PointInputs:
    """Inputs of points [N, 3] seen from `eyes` [N, 3]."""
    covariances, normals = local_shape(means, N_NEIGHBORS)
    normals[np.einsum("ni,ni->n", normals, eyes - means) < 0] *= -1
    return point_inputs(means, normals, covariances, up=np.array([0.0, 0.0, 1.0]))


def worn(
    means: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points with errors as of rendered depth [M, 3], their rows, and which of them float.

    Choices: a share of the points, displaced along the normal by offsets that vary slowly over the
      surface (wavelengths of .4 to 1.2 m and of .1 to .3 m) and by noise; some float before it.
    """
    rows = rng.permutation(len(means))[: int(rng.uniform(0.4, 1) * len(means))]
    normal = normals[rows]
    where = means[rows] + 0.3 * normal  # both sides of an object differ, too
    offset = np.full(len(rows), rng.uniform(-0.02, 0.04))
    for largest, wavelengths in ((0.05, (0.4, 1.2)), (0.03, (0.1, 0.3))):
        waves = rng.normal(size=(64, 3)) * 2 * np.pi / np.sqrt(3) / rng.uniform(*wavelengths)
        phases = rng.uniform(0, 2 * np.pi, 64)
        offset = offset + rng.uniform(0, largest) * np.sqrt(2 / 64) * np.cos(
            where @ waves.T + phases
        ).sum(1)
    adrift = rng.random(len(rows)) < rng.uniform(0, 0.04)
    offset = np.where(adrift, np.abs(rng.normal(0, 0.15, len(rows))), offset)
    noise = rng.uniform(0.001, 0.015) * rng.normal(size=where.shape)
    return means[rows] + offset[:, None] * normal + noise, rows, adrift


def swept(
    images: np.ndarray,
    depth: np.ndarray,
    K: np.ndarray,
    poses: np.ndarray,
    rng: np.random.Generator,
) -> Surface:
    """The surface by a sweep of LEAST_SWEPT or more of the photos, as in a scene without depth.

    Args: depth [V, H, W]: true; 200 pixels of each photo bound the sweep, as matched points do.
    """
    least = min(LEAST_SWEPT, len(poses))
    some = np.sort(
        rng.permutation(len(poses))[: round(np.exp(rng.uniform(*np.log((least, len(poses))))))]
    )
    factor = max(round(max(images.shape[1:3]) / SIDE), 1)
    colors = np.stack([reduced(image, factor) for image in images[some]]) / 255
    Ks = np.tile(K * [[1 / factor], [1 / factor], [1]], (len(some), 1, 1))
    z = [rng.choice(photo[np.isfinite(photo)], 200) for photo in depth[some]]
    depths = depth_of_photos(colors, np.ones(colors.shape[:3], np.float32), Ks, poses[some], z)
    return swept_surface(depths, Ks, poses[some])


def photographed(
    seed: int, n_views: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Images, depth and labels [V, H, W, ...] of a room, K [3, 3] and poses [V, 4, 4]."""
    kind = "modelled" if seed in MODELLED else KINDS[seed % len(KINDS)]
    if kind == "modelled":
        room = furnished(seed, catalogue())
    else:
        room = shuffled(seed) if kind == "shuffled" else layout.build(kind.split()[-1], seed)
    if kind.startswith(("jittered", "shuffled")):
        jitter(room, np.random.default_rng([seed, 2]))
    caster, K = RayCaster(room.soup.vertices, room.soup.triangles), intrinsics(WIDTH, HEIGHT)
    poses = walk(room.size, n_views, seed)
    views = [photograph(room, caster, K, pose, WIDTH, HEIGHT) for pose in poses]
    images, depth, labels = (np.stack(part) for part in zip(*views, strict=True))
    return images, depth, labels, K, poses


@cache
def catalogue() -> Catalogue:
    """The modelled pieces that are installed here."""
    return Catalogue(FOLDER)


def surface(
    depth: np.ndarray,
    labels: np.ndarray,
    K: np.ndarray,
    poses: np.ndarray,
    count: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """About `count` visible points [N, 3], the cameras that saw them [N, 3], their labels [N]."""
    means, eyes, named = [], [], []
    for view, eye in enumerate(centers(poses)):
        pixels = np.argwhere(np.isfinite(depth[view]))
        pixels = pixels[
            rng.choice(len(pixels), min(4 * count // len(poses), len(pixels)), replace=False)
        ]
        means.append(unproject(depth[view], K, poses[view], pixels))
        eyes.append(np.tile(eye, (len(pixels), 1)))
        named.append(labels[view][pixels[:, 0], pixels[:, 1]])
    points = np.concatenate(means)
    rows = thin(points, count)
    return points[rows], np.concatenate(eyes)[rows], np.concatenate(named)[rows]


def prepare(folder: Path, seed: int, settings: TeachSection, matrix: np.ndarray) -> int:
    """Write a room into the folder, unless it is there; returns its seed. In its own process."""
    path = room_path(folder, seed)
    if path.is_file():
        return seed
    network = TeacherInference(
        read_teacher(Path(settings.model) if settings.model else EMBEDDED), 1
    )
    arrays: dict[str, np.ndarray] = {}
    for number, room in enumerate(rooms_of(seed, settings, network, matrix)):
        values = room.inputs._asdict() | {
            "features": room.features,
            "n_views": room.n_views,
            "labels": room.labels,
        }
        arrays |= {f"{name}{number}": value for name, value in values.items()}
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]  # of NumPy's stubs
    return seed


def room_path(folder: Path, seed: int) -> Path:
    """The file of a room."""
    return folder / f"{seed}.npz"


def load_room(folder: Path, seed: int) -> list[Room]:
    """A room that `prepare` wrote: clean, worn, half seen, and swept."""
    with np.load(room_path(folder, seed)) as stored:
        return [
            Room(
                PointInputs(*(stored[f"{name}{number}"] for name in PointInputs._fields)),
                *(stored[f"{name}{number}"] for name in Room._fields[1:]),
            )
            for number in range(4)
        ]
