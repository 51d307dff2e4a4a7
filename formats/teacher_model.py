"""A user's 2D teacher: `NAME.onnx`, and `NAME.toml` beside it that says how to use it."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import InputError
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.files import parse_toml, read_text
from chebsplat.formats.names import check_names, suggest, unprintable
from chebsplat.formats.onnx_files import model_files, model_sha256
from chebsplat.formats.tensors import finite32, read_npz

if TYPE_CHECKING:
    import numpy as np

EMBEDDED = Path(__file__).parents[1] / "teachers/embedded.onnx"  # ships with the package
MAX_LABELS = 2**15 - 1  # the limit of int16 maps
MAX_SIDE = 4096  # pixels of a model's input
LARGEST = (
    4  # largest plausible mean or std of colours in 0 to 1, of models with rescaled inputs, too
)
RESAMPLING = ("nearest", "lanczos", "bilinear", "bicubic", "box", "hamming")  # by Pillow's numbers
LONGEST_ORIGIN = 8192  # characters; servers take no longer addresses
FILES = ("labels", "text", "tokenizer")
TEXT_PACKAGE = "minilm"  # `text` may name the optional extra instead of a file


@dataclass(frozen=True)
class TeacherModel:
    """A 2D teacher and its settings; docs/teachers.md explains each key of the TOML to users.

    path:      the image encoder, `[1, 3, H, W]` float32 -> `[1, C, h, w]`.
    output:    "features", or "logits" of a closed-set segmenter: channel = index into the label
      list.
    guessed:   true where the TOML has no `output`, and labels without embeddings and without `text`
      suggest a segmenter.
    tensor:    the graph's output, or None: the one that fits.
    mean, std: of colours in [0, 1], in the model's channel `order`, "RGB" or "BGR".
    resample:  filter for resizing photos, of RESAMPLING.
    size:      (H, W) that the model takes, or None: any whose sides are multiples of `multiple`.
    base:      long side in pixels that an image is resized to at scale 1, or None: its own.
    origin:    source of a fetched model, sha256: its `model_sha256` then; None if not fetched.
    labels:    table of names and embeddings; text, tokenizer: encoder of any words; prompt: a
      template for names.
    """

    path: Path
    name: str
    output: str = "features"
    mean: tuple[float, ...] = (0.5, 0.5, 0.5)
    std: tuple[float, ...] = (0.5, 0.5, 0.5)
    order: str = "RGB"
    resample: str = "bilinear"
    size: tuple[int, int] | None = None
    multiple: int = 1
    labels: Path | None = None
    text: Path | str | None = None
    tokenizer: Path | None = None
    prompt: str = "{}"
    base: int | None = None
    origin: str | None = None
    sha256: str | None = None
    tensor: str | None = None
    guessed: bool = False

    @property
    def settings(self) -> Path:
        """The TOML beside the model."""
        return self.path.with_suffix(".toml")

    @property
    def channels(self) -> Path:
        """The folder of its channel map, `channels/2`, where it brings one."""
        return self.path.with_suffix(".channels")

    def verify(self) -> None:
        """Raises InputError if the encoder is not the one whose checksum was recorded."""
        if self.sha256 is not None and (digest := model_sha256(self.path)) != self.sha256:
            raise InputError(
                f"{self.path} has the sha256 {digest}, {self.settings} says {self.sha256}: it was "
                "damaged or replaced; "
                f"remove the folder and fetch it again (chebsplat get-teacher), or correct `sha256`"
            )

    def files(self) -> list[Path]:
        """All files that the teacher's results depend on."""
        files = model_files(self.path)
        files.insert(1, self.settings)
        for named in (getattr(self, name) for name in FILES):
            if isinstance(named, Path):
                files += model_files(named) if named == self.text else [named]
        return files

    def digest(self) -> str:
        """One sha256 over these files."""
        return hashlib.sha256(
            "\n".join(sha256_file(file) for file in self.files()).encode()
        ).hexdigest()


def read_teacher(path: Path) -> TeacherModel:
    """The record of a model. Raises InputError naming the file, the key and the remedy."""
    path = Path(path)
    settings = path.with_suffix(".toml")
    if not path.is_file():
        raise InputError(f"{path} is missing; correct teacher.model")
    if path.suffix != ".onnx":
        raise InputError(f"{path} is not an .onnx file; teacher.model names the image encoder")
    if not settings.is_file():
        raise InputError(
            f"{settings} is missing; write it beside the model, with at least mean, std and "
            "labels (docs/teachers.md)"
        )
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in read_settings(settings).items()
    }
    for key in FILES:
        if key in values and not (key == "text" and values[key] == TEXT_PACKAGE):
            values[key] = settings.parent / values[key]
            if not values[key].is_file():
                raise InputError(f"{values[key]} is missing; correct `{key}` in {settings}")
    _check_range(settings, values)
    teacher = TeacherModel(path, **({"name": path.stem} | values))
    if "output" not in values and teacher.labels is not None and teacher.text is None:
        with suppress(InputError):  # raised again where the table is needed
            if read_label_table(teacher.labels)[1] is None:
                teacher = replace(teacher, output="logits", guessed=True)
    if teacher.output == "features" and teacher.labels is None and teacher.text is None:
        raise InputError(
            f"{settings} has neither `labels` nor `text`: no label could be told; add one of them"
        )
    if teacher.output == "logits" and teacher.labels is None:
        raise InputError(
            f"{settings} has no `labels`: the names of the channels are needed; add them"
        )
    if isinstance(teacher.text, Path) and teacher.tokenizer is None:
        raise InputError(
            f"{settings} has `text` without `tokenizer`; add the tokenizer.json of the text encoder"
        )
    if teacher.size is not None and any(side % teacher.multiple for side in teacher.size):
        raise InputError(
            f"{settings}: size {list(teacher.size)} is not a multiple of "
            f"{teacher.multiple}; correct one"
        )
    return teacher


def read_settings(settings: Path) -> dict[str, Any]:
    """The keys of a teacher's TOML, each of the kind that it has to be. Raises InputError."""
    values = parse_toml(settings, "correct it (docs/teachers.md)")
    for key, value in values.items():
        _check(settings, key, value)
    return values


def _is_list(value: Any, kinds: tuple[type, ...], length: int, low: float, high: float) -> bool:
    whole = (
        isinstance(value, list) and len(value) == length and all(type(v) in kinds for v in value)
    )
    return whole and all(low <= v <= high for v in value)


def _is_side(value: Any) -> bool:
    return type(value) is int and 0 < value <= MAX_SIDE


def _is_text(value: Any, longest: int = 1000) -> bool:
    return isinstance(value, str) and 0 < len(value) <= longest and not unprintable(value)


RULES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "name": ("a word", _is_text),
    "output": ('"features" or "logits"', lambda v: v in ("features", "logits")),
    "tensor": ("the name of an output", _is_text),
    "mean": ("three numbers", lambda v: _is_list(v, (int, float), 3, -1e3, 1e3)),
    "std": ("three numbers above 0", lambda v: _is_list(v, (int, float), 3, 1e-6, 1e3)),
    "order": ('"RGB" or "BGR"', lambda v: v in ("RGB", "BGR")),
    "resample": (", ".join(RESAMPLING), lambda v: v in RESAMPLING),
    "size": (
        f"[height, width], 1 to {MAX_SIDE} pixels",
        lambda v: _is_list(v, (int,), 2, 1, MAX_SIDE),
    ),
    "multiple": (f"a whole number, 1 to {MAX_SIDE}", _is_side),
    "base": (f"a whole number of pixels, 1 to {MAX_SIDE}", _is_side),
    "origin": (
        f"a text of at most {LONGEST_ORIGIN:,} characters",
        lambda v: _is_text(v, LONGEST_ORIGIN),
    ),
    "sha256": (
        "64 hexadecimal digits",
        lambda v: isinstance(v, str) and re.fullmatch("[0-9a-f]{64}", v) is not None,
    ),
    "labels": ("a file's name", _is_text),
    "text": ("a file's name", _is_text),
    "tokenizer": ("a file's name", _is_text),
    "prompt": (
        'text with one {} in it, such as "a photo of a {}"',
        lambda v: _is_text(v) and v.count("{}") == 1,
    ),
}


def _check(settings: Path, key: str, value: Any) -> None:
    if key not in RULES:
        near = suggest(key, RULES, 1)
        advice = f"did you mean {near[0]}?" if near else f"known are {', '.join(RULES)}"
        raise InputError(f"{settings}: no such key {key}; {advice}")
    expected, fits = RULES[key]
    if not fits(value):
        raise InputError(f"{settings}: {key} = {value!r:.60} is not {expected}; correct it")


def _check_range(settings: Path, values: dict[str, Any]) -> None:
    """Refuse mean and std of colours in 0 to 255: with them all photos would look alike.

    Choices: a std of 1 beside such a mean is of colours in 0 to 255, too, as Caffe's models have
      it.
    """
    large = [key for key in ("mean", "std") if max(values.get(key, [0])) > LARGEST]
    if large == ["mean"] and {*values.get("std", ())} == {1}:
        large = ["mean", "std"]
    if large:
        advice = ", ".join(
            f"{key} = {[float(f'{v / 255:.4g}') for v in values[key]]}" for key in large
        )
        what = f"{' and '.join(large)} of colours in 0 to 255, where those of 0 to 1 are needed"
        raise InputError(f"{settings}: {what}; write {advice}")


def read_label_table(path: Path) -> tuple[list[str], np.ndarray | None]:
    """Names [L] and embeddings f32 [L, C], or None where the file holds names alone.

    Args: path: .npz with `names` and, for features, `embeddings`; or a text file of names, one a
      line.
    Raises: InputError naming the file and the remedy.
    """
    if path.suffix != ".npz":
        return list(read_label_set(path)), None

    arrays = read_npz(path, ("names", "embeddings"), "write it again, with names and embeddings")
    listed, embeddings = arrays.get("names"), arrays.get("embeddings")
    if (
        listed is None
        or listed.ndim != 1
        or listed.dtype.kind != "U"
        or not 0 < len(set(listed)) == len(listed)
    ):
        raise InputError(
            f"{path}: names are missing, occur twice or are no list of words; write it again"
        )
    names = [str(name) for name in listed]
    check_names(names, "names", path, "write it again")
    if embeddings is None:
        return names, None
    rows = finite32(embeddings)
    if rows is None or rows.ndim != 2 or len(rows) != len(names) or not rows.size:
        raise InputError(
            f"{path}: embeddings {embeddings.dtype} {embeddings.shape} do not fit {len(names)} "
            "names, or are not "
            "finite; write it again"
        )
    return names, rows


def read_label_set(path: Path) -> dict[str, list[str]]:
    """Names in order, each with the words that mean it: itself, then its synonyms.

    The file is plain text: `name` or `name: synonym, synonym` a line; `#` begins a comment.
    Raises: InputError naming the file, the line and the remedy.
    """
    lines = read_text(path, "labels are plain text, one name a line").splitlines()
    words_of: dict[str, list[str]] = {}
    for number, line in enumerate(lines, start=1):
        name, _, others = (part.strip() for part in line.partition("#")[0].partition(":"))
        if not name and not others:
            continue
        if not name or name in words_of:
            raise InputError(
                f"{path}, line {number}: a name is "
                f"{'given twice' if name else 'missing'}; correct it"
            )
        words = [name, *(word.strip() for word in others.split(",") if word.strip())]
        words_of[name] = list(dict.fromkeys(words))
        check_names(words_of[name], f"line {number}", path, "correct it")
    if not 0 < len(words_of) <= MAX_LABELS:
        raise InputError(
            f"{path} holds {len(words_of)} labels; 1 to {MAX_LABELS} are possible, one name a line"
        )
    return words_of
