"""`make teacher`: train the embedded teacher by LSeg's recipe, export it, and measure it.

Choices: cross entropy over the cosines of a pixel's vector with one word of each class, drawn anew
  for every step, so that the vectors suit all words for a class; and a pull towards the embedding
  of the class's words themselves, without which vectors need only differ by class, and mean nothing
  to words that were not in training. Rare classes weigh more. Weights are averaged over the last
  steps. bfloat16 in the convolutions: twice the speed, no measurable loss.
"""

from __future__ import annotations

import copy
import csv
import logging
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from chebsplat.evaluation.metrics import confusion, segmentation
from chebsplat.formats.teacher_model import EMBEDDED
from chebsplat.stages.runtime.progress import Progress
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import TRAINING
from chebsplat.teachers.network import Encoder, Trunk, export, span
from chebsplat.teachers.rooms import KINDS, crops, recolored, rendered
from chebsplat.teachers.words import embedded, words

ROOMS, VALIDATION, VIEWS = TRAINING[:480], TRAINING[-12:], 8  # rooms, and views of each
# drawn twice as often as rooms of the other kinds, of which there are twice as many
PRESETS = ("office", "room")
BATCH, HEIGHT, WIDTH = 8, 192, 256  # crops
RATE, DECAY, WARM_UP = 2e-3, 0.02, 100
TEMPERATURE, PULL = 0.07, 0.2
AVERAGE = 0.995  # of the weights, from step to step
MEAN, STD = (0.5, 0.5, 0.5), (0.25, 0.25, 0.25)


def class_weights(labels: np.ndarray) -> Tensor:
    """[22] ∝ frequency^-0.3, 1 on average, at most 3."""
    counts = np.bincount(labels[labels >= 0].astype(np.int64), minlength=len(CLASS_NAMES)).clip(1)
    weights = (counts / counts.sum()) ** -0.3
    return torch.tensor((weights / weights.mean()).clip(0, 3), dtype=torch.float32)


def normalized(images: Tensor) -> Tensor:
    """Images [B, 3, H, W] in [0, 1] as the network takes them."""
    shape = (1, 3, 1, 1)
    return ((images - torch.tensor(MEAN).view(shape)) / torch.tensor(STD).view(shape)).contiguous(
        memory_format=torch.channels_last
    )


def rate(step: int, steps: int) -> float:
    """Factor of the learning rate at a step: a short warm-up, then half a cosine."""
    return min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + float(np.cos(np.pi * step / steps)))


@torch.no_grad()
def validated(trunk: Trunk, images: np.ndarray, labels: np.ndarray, texts: Tensor) -> float:
    """mIoU at the network's resolution."""
    trunk.eval()
    matrix = np.zeros((len(CLASS_NAMES),) * 2, np.int64)
    for image, label in zip(images, labels, strict=True):
        vectors = trunk(normalized(torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255))
        best = torch.einsum("bchw,lc->blhw", vectors, texts).argmax(1)[0].numpy()
        matrix += confusion(best, label[1::2, 1::2].astype(np.int64), len(CLASS_NAMES))
    return segmentation(matrix).miou


@dataclass
class Target:
    """Target of the vectors: basis [384, RANK]; in its coordinates the words [W, RANK] of classes
    owner [W], the classes' mean words [22, RANK], unit, and their names [22, RANK].
    """

    basis: Tensor
    words: Tensor
    owner: np.ndarray
    means: Tensor
    names: Tensor

    def drawn(self, rng: np.random.Generator) -> Tensor:
        """One word of each class, [22, RANK]."""
        return self.words[
            [int(rng.choice(np.flatnonzero(self.owner == k))) for k in range(len(self.means))]
        ]


def target() -> Target:
    """Choices: the basis holds all words of training, and each class's mean three times over."""
    listed = words("training")
    owner = np.repeat(np.arange(len(listed)), [len(of) for of in listed.values()])
    vectors = torch.from_numpy(embedded([word for of in listed.values() for word in of]))
    means = F.normalize(
        torch.stack([vectors[owner == k].mean(0) for k in range(len(listed))]), dim=1
    )
    basis = span(torch.cat([vectors, 3 * means]))
    texts, means = vectors @ basis, F.normalize(means @ basis, dim=1)
    names = torch.stack([texts[int(np.flatnonzero(owner == k)[0])] for k in range(len(listed))])
    return Target(basis, texts, owner, means, names)


def train(
    rooms: tuple[np.ndarray, np.ndarray],
    share: np.ndarray,
    validation: tuple[np.ndarray, np.ndarray],
    steps: int,
    out: Path,
) -> Encoder:
    """Trains on views, each drawn with its share; the log goes to out/training.csv, the network to
    out/teacher.pt.

    Args: rooms, validation: images u8 [N, H, W, 3] and labels i8 [N, H, W]; share [N], its sum 1.
    """
    torch.manual_seed(0)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    (images, labels), aim = rooms, target()
    trunk = Trunk().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(trunk)
    weights = class_weights(labels)
    optimizer = torch.optim.AdamW(trunk.parameters(), lr=RATE, weight_decay=DECAY)
    sums, last = np.zeros(3), steps - 1
    with (out / "training.csv").open("w", newline="") as stream:
        log = csv.writer(stream)
        log.writerow(["step", "loss", "accuracy", "validation_miou"])
        for step, status in Progress(every=20).track(range(steps), steps, "teacher"):
            optimizer.param_groups[0]["lr"] = RATE * rate(step, steps)
            index = rng.choice(len(images), BATCH, replace=False, p=share)
            views = torch.from_numpy(images[index]), torch.from_numpy(labels[index])
            image, label = crops(*views, HEIGHT, WIDTH, generator)
            image, texts = normalized(recolored(image, generator)), aim.drawn(rng)
            trunk.train()
            with torch.autocast("cpu", torch.bfloat16):
                vectors = trunk(image)
            vectors, truth = vectors.permute(0, 2, 3, 1)[label >= 0], label[label >= 0]
            cosines = vectors.float() @ texts.T
            pull = (1 - (vectors * aim.means[truth]).sum(1)).mean()
            loss = F.cross_entropy(cosines / TEMPERATURE, truth, weights) + PULL * pull
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(trunk.parameters(), 5.0)
            optimizer.step()
            average_in(average, trunk, min(AVERAGE, (step + 1) / (step + 20)))
            sums += 1, float(loss.detach()), float((cosines.argmax(1) == truth).float().mean())
            if (step + 1) % 100 == 0 or step == last:
                status["loss"] = f"{sums[1] / sums[0]:.3f}"
                miou = ""
                if (step + 1) % 500 == 0 or step == last:
                    miou = status["mIoU"] = f"{validated(average, *validation, aim.names):.4f}"
                    torch.save(
                        {"trunk": average.state_dict(), "basis": aim.basis}, out / "teacher.pt"
                    )
                log.writerow(
                    [step + 1, f"{sums[1] / sums[0]:.4f}", f"{sums[2] / sums[0]:.4f}", miou]
                )
                stream.flush()
                sums[:] = 0
    return Encoder(average, aim.basis)


@torch.no_grad()
def average_in(average: Trunk, trunk: Trunk, decay: float) -> None:
    """Moves the averaged weights towards the trunk's."""
    for a, b in zip(average.state_dict().values(), trunk.state_dict().values(), strict=True):
        a.lerp_(b, 1 - decay) if a.is_floating_point() else a.copy_(b)


@click.command()
@click.option("--steps", default=3600, show_default=True)
@click.option("--threads", default=4, show_default=True, help="of torch, and processes that render")
@click.option(
    "--cache", type=click.Path(path_type=Path), default=Path("build/teacher"), help="rendered rooms"
)
@click.option(
    "--out", type=click.Path(path_type=Path), default=EMBEDDED.parent, help="the model goes here"
)
def main(steps: int, threads: int, cache: Path, out: Path) -> None:
    """Render the rooms, train, and export the embedded teacher."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(threads)
    out.mkdir(parents=True, exist_ok=True)
    rooms = rendered(cache / "rooms", ROOMS, VIEWS, threads)
    validation = rendered(cache / "rooms", VALIDATION, VIEWS, threads)
    often = np.repeat(
        [2.0 if KINDS[seed % len(KINDS)] in PRESETS else 1.0 for seed in ROOMS], VIEWS
    )
    encoder = train(rooms, often / often.sum(), validation, steps, cache)
    (out / "training.csv").write_bytes((cache / "training.csv").read_bytes())
    export(encoder, out, MEAN, STD)


if __name__ == "__main__":
    main()
