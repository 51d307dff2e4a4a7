"""`make teacher-quality`: figures of the shipped model on rooms and houses that it has never seen.

Choices: the model is run as the teacher stage runs it, one pass a view, no flips; each class has
  one word as its query, and a pixel goes to the word of the greatest cosine after bilinear
  upsampling; one confusion matrix over all views.
"""

from __future__ import annotations

import json
import os
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from PIL import Image
from torch.nn import functional as F

from chebsplat.evaluation.metrics import IGNORE, confusion, segmentation
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.stages.sources.generated import photograph
from chebsplat.stages.teacher_models.image_encoder import TeacherInference
from chebsplat.stages.teacher_models.text_encoder import text_embeddings
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import HELD_OUT, build
from chebsplat.synthetic.rays import RayCaster, intrinsics, walk
from chebsplat.teachers.words import words

VIEWS, WIDTH, HEIGHT = 8, 320, 240  # of each held-out room, along its path
HOUSES = ("house_kitchen", "house_living")
MAPPING = Path(__file__).parent / "houses.toml"
View = tuple[np.ndarray, np.ndarray]  # image u8 [H, W, 3], class index i64 [H, W]


def labelled(vectors: np.ndarray, texts: np.ndarray, height: int, width: int) -> np.ndarray:
    """Index i64 [height, width] of the text [L, C] of greatest cosine for vectors [C, h, w]."""
    cosines = torch.einsum("lc,chw->lhw", torch.from_numpy(texts), torch.from_numpy(vectors))[None]
    return (
        F.interpolate(cosines, (height, width), mode="bilinear", align_corners=False)[0]
        .argmax(0)
        .numpy()
    )


def held_out_room(
    seed: int, n_views: int = VIEWS, width: int = WIDTH, height: int = HEIGHT
) -> list[View]:
    """Views of a held-out room along its path, as the named scenes are photographed."""
    room = build("office" if seed < HELD_OUT[len(HELD_OUT) // 2] else "room", seed)
    caster, K = RayCaster(room.soup.vertices, room.soup.triangles), intrinsics(width, height)
    shots = [
        photograph(room, caster, K, pose, width, height) for pose in walk(room.size, n_views, seed)
    ]
    return [(image, labels.astype(np.int64)) for image, _, labels in shots]


def house(folder: Path, names: list[str]) -> Iterator[View]:
    """All views of a house at half size; labels that the mapping leaves out are IGNORE."""
    mapping = tomllib.loads(MAPPING.read_text())
    listed = json.loads((folder / "scene.json").read_text())["labels"]
    table = np.full(256, IGNORE, np.int64)
    for key, label in listed.items():
        if label in mapping:
            table[int(key)] = names.index(mapping[label])
    for path in sorted((folder / "images").glob("*.png")):
        with Image.open(path) as image, Image.open(folder / "semantic" / path.name) as semantic:
            half = image.convert("RGB").resize(
                (image.width // 2, image.height // 2), Image.Resampling.BOX
            )
            yield np.asarray(half), table[np.asarray(semantic)[::2, ::2]]


def figures(matrix: np.ndarray, names: list[str]) -> dict[str, Any]:
    """mIoU, mAcc, OA and IoU by class of a confusion matrix [L, L], to four digits."""
    scores = segmentation(matrix)
    iou = {
        name: round(float(v), 4)
        for name, v in zip(names, scores.iou, strict=True)
        if not np.isnan(v)
    }
    return {
        "miou": round(scores.miou, 4),
        "macc": round(scores.macc, 4),
        "oa": round(scores.oa, 4),
        "iou": iou,
    }


def runner(model: Path, threads: int) -> Callable[[np.ndarray], np.ndarray]:
    """From a view u8 [H, W, 3], sides multiples of the model's, to vectors f32 [C, h, w]."""
    encoder = TeacherInference(read_teacher(model), threads)
    return lambda image: encoder.run(image, "a view")


def measured(model: Path, data: Path, threads: int) -> dict[str, Any]:
    """All figures; the houses only where their folders are."""
    encode, teacher, names = runner(model, threads), read_teacher(model), list(CLASS_NAMES)
    texts, unseen = text_embeddings(names, teacher), words("unseen")
    draws = len(next(iter(unseen.values())))
    others = [text_embeddings([unseen[name][k] for name in names], teacher) for k in range(draws)]
    n = len(names)
    matrix, strange, seconds = np.zeros((n, n), np.int64), np.zeros((draws, n, n), np.int64), []
    for seed in HELD_OUT:
        for image, truth in held_out_room(seed):
            began = time.perf_counter()
            vectors = encode(image)
            seconds.append(time.perf_counter() - began)
            matrix += confusion(labelled(vectors, texts, *truth.shape), truth, n)
            for k, rows in enumerate(others):
                strange[k] += confusion(labelled(vectors, rows, *truth.shape), truth, n)
    result: dict[str, Any] = {
        "held_out": {
            "rooms": len(HELD_OUT),
            "views": len(HELD_OUT) * VIEWS,
            **figures(matrix, names),
        },
        "unseen_words": [
            {"words": [unseen[name][k] for name in names], **figures(strange[k], names)}
            for k in range(draws)
        ],
        "encode": {
            "seconds": round(float(np.median(seconds)), 4),
            "size": [WIDTH, HEIGHT],
            "threads": threads,
            "load": round(os.getloadavg()[0], 1),
        },
    }
    classes = [name for name in names if name in set(tomllib.loads(MAPPING.read_text()).values())]
    for name in HOUSES:
        if (data / name).is_dir():
            result[name] = house_figures(
                encode, data / name, classes, text_embeddings(classes, teacher)
            )
        else:
            click.echo(f"{data / name} is not there: not measured (CHEBSPLAT_TEST_DATA)", err=True)
    return result


def house_figures(
    encode: Callable, folder: Path, classes: list[str], texts: np.ndarray
) -> dict[str, Any]:
    """Figures of an encoder over views of a modelled house, and the share of counted pixels."""
    matrix, counted, total, views = np.zeros((len(classes),) * 2, np.int64), 0, 0, 0
    for image, truth in house(folder, classes):
        matrix += confusion(labelled(encode(image), texts, *truth.shape), truth, len(classes))
        counted, total, views = (
            counted + int((truth != IGNORE).sum()),
            total + truth.size,
            views + 1,
        )
    return {"views": views, "counted": round(counted / total, 4), **figures(matrix, classes)}


def table(result: dict[str, Any]) -> str:
    """The figures as markdown."""
    columns = {"held-out rooms": result["held_out"]} | {
        name: result[name] for name in HOUSES if name in result
    }
    columns |= {f"unseen words {k + 1}": part for k, part in enumerate(result["unseen_words"])}
    encode = result["encode"]
    lines = [
        "Written by `make teacher-quality`; IoU of each class, one confusion matrix a column.",
        "",
        "| | " + " | ".join(columns) + " |",
        "|---|" + "---|" * len(columns),
    ]
    for key, title in (
        ("miou", "**mIoU**"),
        ("oa", "**pixels right**"),
        ("views", "views"),
        ("counted", "counted"),
    ):
        lines.append(
            f"| {title} | " + " | ".join(str(part.get(key, "")) for part in columns.values()) + " |"
        )
    for name in CLASS_NAMES:
        cells = [
            f"{part['iou'][name]:.3f}" if name in part["iou"] else "" for part in columns.values()
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    drawn = [", ".join(part["words"]) for part in result["unseen_words"]]
    lines += [
        "",
        "Counted: share of pixels whose label has a counterpart (houses.toml). Unseen words, in "
        f"the order of classes: {'; '.join(f'{k}: {row}' for k, row in enumerate(drawn, 1))}.",
        "",
        f"One view of {encode['size'][0]} x {encode['size'][1]}: {encode['seconds']} s (median), "
        f"{encode['threads']} threads of onnxruntime, load average {encode['load']}.",
    ]
    return "\n".join(lines) + "\n"


@click.command()
@click.option("--model", type=click.Path(path_type=Path), default=EMBEDDED)
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    envvar="CHEBSPLAT_TEST_DATA",
    default=Path("../shared/data"),
)
@click.option("--threads", default=4, show_default=True, help="of onnxruntime")
def main(model: Path, data: Path, threads: int) -> None:
    """Measure the model; write quality.json and quality.md beside it."""
    result = measured(model, data, threads)
    (model.parent / "quality.json").write_text(json.dumps(result, indent=1) + "\n")
    (model.parent / "quality.md").write_text(table(result))
    click.echo(table(result))


if __name__ == "__main__":
    main()
