"""A generated scene for pages: the inside of a box with a sofa and a chair, and a teacher of ten
words.
"""

import numpy as np
from shared import KEY

from chebsplat.formats import artifact
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.calibration import TeacherCalibration, beside, write_calibration
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.features import Features
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.packed import C0
from chebsplat.formats.ply import write_ply
from chebsplat.formats.scene import Scene
from chebsplat.labels.calibration import Calibration

LABELS = ["wall", "floor", "ceiling", "sofa", "chair"]
MORE = ["seat", "object", "things", "stuff", "texture"]
RIVALS = [*LABELS, MORE[0]]
CALIBRATION = Calibration(margin=12.0, cosine=6.0, bias=-0.2, strength=1.0, offset=-1.5)
SIZE = (320, 240)
N = 20_000


def words():
    """Unit embeddings of all words in eight channels; a seat is a sofa and a chair."""
    rows = np.eye(10, 8) + 0.2 * np.random.default_rng(7).normal(size=(10, 8))
    rows[5] = rows[3] + rows[4]
    rows[6:] = 0.5 * rows[6:] + 0.4
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def room(n=N, seed=0):
    """n Gaussians on the inside of a box of 5 x 4 x 2.5 and on two blocks in it; colour varies
    along surfaces.
    """
    rng = np.random.default_rng(seed)
    boxes = [
        ((-2.5, -2, 0), (2.5, 2, 2.5)),
        ((-1.5, 0.8, 0), (0.2, 1.7, 0.9)),
        ((0.8, 0.2, 0), (1.5, 0.9, 1.1)),
    ]
    shares = rng.choice(3, n, p=[0.7, 0.18, 0.12])
    low, high = (np.array([box[side] for box in boxes])[shares] for side in (0, 1))
    means = low + rng.random((n, 3)) * (high - low)
    axis, side = rng.choice(3, n, p=[0.3, 0.3, 0.4]), rng.integers(0, 2, n)
    means[np.arange(n), axis] = np.where(side[:, None], high, low)[np.arange(n), axis]
    labels = np.where(shares > 0, shares + 2, np.where(axis < 2, 0, np.where(side, 2, 1))).astype(
        np.int32
    )
    log_scales = np.full((n, 3), np.log(0.05)) + rng.normal(0, 0.3, (n, 3))
    log_scales[np.arange(n), axis] = np.log(0.004)
    phase = means @ rng.normal(0, 2, (3, 3)) + labels[:, None] * np.array([1.0, 2.1, 3.3])
    quats = np.concatenate([np.ones((n, 1)), rng.normal(0, 0.05, (n, 3))], 1) * rng.uniform(
        0.5, 2, (n, 1)
    )
    features = words()[labels] * rng.uniform(0.8, 1.2, (n, 1)) + rng.normal(0, 0.1, (n, 8))
    parameters = {
        "means": means, "log_scales": log_scales, "quats": quats,
        "logit_opacities": rng.normal(1.5, 1.0, n),
        "sh0": (0.5 + 0.4 * np.sin(phase) - 0.5)[:, None] / C0, "shN": np.zeros((n, 15, 3)),
        "features": features,
    }  # fmt: skip
    parameters = {name: values.astype(np.float32) for name, values in parameters.items()}
    parameters["shN"][: n // 2, :3] = rng.normal(0, 0.15, (n // 2, 3, 3))
    parameters["degrees"] = np.repeat([1, 0], [n // 2, n - n // 2]).astype(np.uint8)
    order = np.argsort(parameters["degrees"], kind="stable")
    return {name: values[order] for name, values in parameters.items()}, labels[order], order


def looking(eye, target):
    ahead = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(ahead, right), ahead
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def made(folder, calibrated=False):
    """A folder of links of a scene with a teacher that knows ten words; as read from it.

    calibrated: whether the teacher's relevancy is: RIVALS are the words that others are weighed
      against.
    """
    model = folder.parent / "toy.onnx"
    model.write_bytes(b"not run by a page")
    model.with_suffix(".toml").write_text('labels = "toy.npz"\n')
    np.savez(folder.parent / "toy.npz", names=np.array(LABELS + MORE), embeddings=words())
    if calibrated:
        of = TeacherCalibration("toy", sha256_file(model), RIVALS, CALIBRATION._asdict(), {})
        write_calibration(beside(model), of)
    parameters, labels, order = room()
    K = np.array([[220.0, 0, 163], [0, 222, 118], [0, 0, 1]])
    poses = np.stack([looking((x, -1.6, 1.5), (0, 1, 0.8)) for x in (-1.5, 0, 1.5)])
    views = ["a.png", "b.png", "c.png"]
    cameras = Cameras(views, np.stack([K] * 3), poses, *SIZE)
    held = Scene(parameters, cameras, order, labels, LABELS, words()[:5])
    with artifact.publish(folder / "export", Manifest("chebsplat.scene/5", KEY, "export")) as tmp:
        held.write(tmp)
    convention = {"kind": "onnx", "output": "features", "sha256": sha256_file(model)}
    features = Features(
        views, np.zeros((3, 2, 2, 8), np.float16), LABELS, words()[:5], convention=convention
    )
    facts = {"config": {"teacher": {"model": str(model)}}}
    with artifact.publish(
        folder / "teacher", Manifest("chebsplat.features/2", KEY, "teacher", **facts)
    ) as tmp:
        features.write(tmp)
    return folder, Scene.read(folder / "export")


def foreign_ply(path, n=300):
    """A box room as a 3DGS PLY from elsewhere: no semantics, SH to degree 1."""
    parameters, _, _ = room(n)
    write_ply(path, {name: values for name, values in parameters.items() if name != "degrees"}, 1)
    return path
