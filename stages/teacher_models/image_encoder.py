"""Inference of a teacher's ONNX image encoder over windows, scales and flips of a view."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
import onnxruntime
from PIL import Image

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats.record import Stack
from chebsplat.formats.teacher_model import MAX_SIDE, TeacherModel, read_label_table
from chebsplat.labels.scores import LOGITS, kind_of, probabilities
from chebsplat.labels.tiling import blended, window_starts
from chebsplat.stages.teacher_models.onnx_session import Model

log = logging.getLogger("chebsplat")
MAX_WINDOWS = 4096  # of a view
SHARED = 8  # images that tell how common a segmenter's classes are
JUDGED = 4  # images by which the kind of a segmenter's values is judged
MAX_SHARE = 0.5  # of the image's side that an entry of the map may be wide


class TeacherInference:
    """One teacher, `[1, 3, H, W]` float32 -> `[1, C, h, w]`, run window by window: on a CPU a batch
    gains nothing.

    scores: kind of a segmenter's values, set by `judge`.
    Args: threads: that onnxruntime may use; device: cpu, or cuda where onnxruntime has it.
    Raises: InputError naming a model that cannot be used.
    """

    def __init__(self, teacher: TeacherModel, threads: int, device: str = "cpu"):
        teacher.verify()
        self.teacher = teacher
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.use_deterministic_compute = True
        # leave the cores to others
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        remedy = f"correct `size` or `multiple` in {teacher.settings}, or export it again"
        self.model = Model(teacher.path, remedy, options, device)
        self.size = self._window_size()
        self.scores = LOGITS
        self._place: int | None = None  # of the output that is the map, from the first run on
        self._last = False  # true where its channels come last

    def _window_size(self) -> tuple[int, int] | None:
        """(H, W) of the graph or of the TOML; None where the model takes any size."""
        path, entries = self.teacher.path, self.model.inputs
        shape, kind = list(entries[0].shape), entries[0].type
        if len(entries) != 1:
            raise InputError(
                f"{path} has {len(entries)} inputs; one image [1, 3, H, W] is "
                "needed: export it again"
            )
        if len(shape) != 4 or ((isinstance(shape[1], int) or shape[3] == 3) and shape[1] != 3):
            raise InputError(
                f"{path} takes {shape}; one image [1, 3, H, W] is needed: export it again"
            )
        if kind != "tensor(float)":
            raise InputError(
                f"{path} takes {kind}; export it with a float32 input (weights may be float16)"
            )
        fixed = tuple(side for side in shape[2:] if isinstance(side, int))
        if max(fixed, default=0) > MAX_SIDE:
            raise InputError(
                f"{path} takes {list(fixed)}; sides up to {MAX_SIDE} pixels are possible"
            )
        if len(fixed) < 2:
            return self.teacher.size
        if self.teacher.size not in (None, fixed):
            raise InputError(
                f"{path} takes {list(fixed)}, {self.teacher.settings} says size = "
                f"{list(self.teacher.size or ())}; correct it"
            )
        return fixed[0], fixed[1]

    def scaled_size(self, image: np.ndarray, scale: float) -> tuple[int, int]:
        """(H, W) of an image at a scale; the aspect ratio stays, to half a pixel."""
        height, width = image.shape[:2]
        factor = scale * (self.teacher.base / max(height, width) if self.teacher.base else 1)
        size = max(round(height * factor), 1), max(round(width * factor), 1)
        if max(size) > MAX_SIDE:
            raise InputError(
                f"{self.teacher.settings}: an image of {size[1]} x {size[0]} is beyond {MAX_SIDE} "
                "pixels a side; lower `base` or teacher.scales"
            )
        return size

    def window(self, size: tuple[int, int]) -> tuple[int, int]:
        """Size of the model's input for an image: fixed, or the image's up to a multiple."""
        if self.size is not None:
            return self.size
        height, width = (
            math.ceil(side / self.teacher.multiple) * self.teacher.multiple for side in size
        )
        return height, width

    def grid(self, image: np.ndarray, downscale: int) -> tuple[tuple[int, int], int]:
        """((h, w), C): entries of a view's map, and the encoder's channels.

        Choices: an entry is `downscale` pixels of the view wide, or as wide as the model's own at
          scale 1 where these are wider.
        """
        scaled = self.scaled_size(image, 1.0)
        side = self.window(scaled)
        count = math.prod(len(window_starts(n, m)) for n, m in zip(scaled, side, strict=True))
        if count > MAX_WINDOWS or max(side) > MAX_SIDE:
            raise InputError(
                f"{self.teacher.settings}: a view takes {count:,} windows of {side[1]} x "
                f"{side[0]}; {MAX_WINDOWS:,} of sides up to {MAX_SIDE} are possible: correct "
                "`base`, `size` or `multiple`"
            )
        cells = self.run(
            _padded(self._resized(image, scaled), side)[: side[0], : side[1]], "the first view"
        )
        sides = []
        for n, m, window, count in zip(image.shape[:2], scaled, side, cells.shape[1:], strict=True):
            entry = max(window / count * n / m, downscale)
            if entry > MAX_SHARE * n:
                raise InputError(
                    f"{self.teacher.path} gives one feature every {entry:.0f} pixels, for views of "
                    f"{n}; give larger images, or `base` in {self.teacher.settings}"
                )
            sides.append(math.ceil(n / entry - 1e-9))
        return (sides[0], sides[1]), cells.shape[0]

    def judge(self, images: Stack | list[np.ndarray]) -> None:
        """Set `scores`, the kind of a segmenter's values, from a few of the images."""
        few = images[:: -(-len(images) // JUDGED)]
        self.scores = kind_of([self.run(self.middle(image), "a view") for image in few])
        if self.scores != LOGITS:
            log.info(
                "%s gives values of %s, not logits: taken as such",
                self.teacher.path.name,
                self.scores,
            )

    def class_shares(self, images: Stack | list[np.ndarray], grid: tuple[int, int]) -> np.ndarray:
        """Mean probability [C] of a segmenter's classes in a few of the images."""
        few = images[:: -(-len(images) // SHARED)]
        maps = [self.features(image, grid, (1.0,), False, "a view") for image in few]
        return np.asarray(np.mean([values.mean((0, 1)) for values in maps], 0))

    def middle(self, image: np.ndarray, side: tuple[int, int] | None = None) -> np.ndarray:
        """The window in an image's middle, u8 [H, W, 3]; side: its (H, W), None: the usual."""
        size = self.scaled_size(image, 1.0)
        side = side or self.window(size)
        resized = self._resized(image, size)
        top, left = (max(n - m, 0) // 2 for n, m in zip(size, side, strict=True))
        return _padded(resized[top : top + side[0], left : left + side[1]], side)

    def features(
        self,
        image: np.ndarray,
        grid: tuple[int, int],
        scales: tuple[float, ...],
        flips: bool,
        name: str,
    ) -> np.ndarray:
        """The map f32 [h, w, C] of a view, u8 [H, W, 3]: unit features, or class probabilities.

        Choices: every window's entries are normalised before windows are blended; every scale's and
          flip's map has the same weight in the mean, which is normalised again. Padding repeats the
          image's edge.
        """
        total = np.zeros(0)
        for scale in scales:
            size = self.scaled_size(image, scale)
            side, resized = self.window(size), self._resized(image, size)
            for flip in (False, True) if flips else (False,):
                padded = _padded(resized[:, ::-1] if flip else resized, side)

                def entries(
                    top: int, left: int, padded: Any = padded, side: Any = side
                ) -> np.ndarray:
                    output = self.run(padded[top : top + side[0], left : left + side[1]], name)
                    if self.teacher.output == "logits":
                        return probabilities(output, self.scores)
                    return unit(output, 0)

                part = self._normal(blended(entries, size, side, grid))
                part = part[:, ::-1] if flip else part
                total = total + part if total.size else part
        return self._normal(total)

    def _normal(self, values: np.ndarray) -> np.ndarray:
        return (
            values / values.sum(-1, keepdims=True)
            if self.teacher.output == "logits"
            else unit(values, -1)
        )

    def run(self, window: np.ndarray, name: str) -> np.ndarray:
        """The model's output f32 [C, h, w] for one window u8 [H, W, 3]; name: for errors.

        Raises: InputError on a model that does not run or gives another rank; DataFailure on
          non-finite values.
        """
        teacher = self.teacher
        mean, std = (np.array(v, np.float32)[:, None, None] for v in (teacher.mean, teacher.std))
        fed = window[..., ::-1] if teacher.order == "BGR" else window
        image = fed.transpose(2, 0, 1).astype(np.float32, order="C")
        image /= 255
        image -= mean
        image /= std
        outputs = self.model.run({self.model.inputs[0].name: image[None]})
        if self._place is None:
            self._place, self._last = self._place_of(outputs)
        output = outputs[self._place]
        if output.dtype.kind in "iu" and (output.ndim == 3 or output.shape[1:2] == (1,)):
            raise InputError(
                f"{teacher.path} gives the likeliest class alone, {list(output.shape)}; export its "
                "logits"
            )
        if output.ndim != 4 or output.shape[0] != 1 or not output.size:
            raise InputError(
                f"{teacher.path} gives {list(output.shape)}; [1, C, h, w] is needed: "
                "export it again"
            )
        output = np.moveaxis(output, 3, 1) if self._last else output
        if not np.isfinite(output).all():
            raise DataFailure(
                f"{teacher.path} gives {np.sum(~np.isfinite(output))} non-finite values for "
                f"{name}; check mean and std in {teacher.settings}, and export it in float32"
            )
        return output[0].astype(np.float32)

    def _resized(self, image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        if image.shape[:2] == size:
            return image
        how = Image.Resampling[self.teacher.resample.upper()]
        return np.asarray(Image.fromarray(image).resize((size[1], size[0]), how))

    def _place_of(self, outputs: list[np.ndarray]) -> tuple[int, bool]:
        """Index of the output that is the map, by the TOML's name or by the labels; true where its
        channels come last.

        Raises: InputError listing the outputs where none or several fit.
        """
        teacher = self.teacher
        names = [entry.name for entry in self.model.outputs]
        listed = ", ".join(
            f"{name} {list(value.shape)}" for name, value in zip(names, outputs, strict=True)
        )
        requested = [k for k, name in enumerate(names) if teacher.tensor in (None, name)]
        if not requested:
            why = f"no output is called {teacher.tensor}: there are {listed}"
            raise InputError(f"{teacher.settings}: {why}; correct `tensor`")
        maps = [
            k
            for k in requested
            if outputs[k].ndim == 4 and len(outputs[k]) == 1 and outputs[k].size
        ]
        table, embeddings = (
            ([], None) if teacher.labels is None else read_label_table(teacher.labels)
        )
        n_channels = None if embeddings is None else embeddings.shape[1]
        if teacher.output == "logits":
            n_channels = len(table)
        first, last = (
            [k for k in maps if n_channels in (None, outputs[k].shape[axis])] for axis in (1, 3)
        )
        matches = first or last
        if len(matches) == 1:
            if not first:
                log.info(
                    "%s gives %s: channels come last, and are taken so", teacher.path.name, listed
                )
            elif len(requested) > 1:
                log.info("%s gives %s: %s is taken", teacher.path.name, listed, names[matches[0]])
            return matches[0], not first
        if len(requested) == 1:  # a wrong number of channels is an error later, with its remedy
            return requested[0], False
        fit = f"{'more than one' if matches else 'none'} fits {teacher.labels or '[1, C, h, w]'}"
        raise InputError(
            f"{teacher.path} gives {listed}: {fit}; name the right one as `tensor` "
            f"in {teacher.settings}"
        )


def unit(values: np.ndarray, axis: int) -> np.ndarray:
    """Unit vectors along an axis; a vector of length 0 stays."""
    return values / np.linalg.norm(values, axis=axis, keepdims=True).clip(1e-6)


def _padded(image: np.ndarray, side: tuple[int, int]) -> np.ndarray:
    """An image padded to `side` at least."""
    below, right = (max(side[k] - image.shape[k], 0) for k in (0, 1))
    return np.pad(image, ((0, below), (0, right), (0, 0)), "edge")
