"""A 2D teacher as its user brings it: `NAME.onnx`, and `NAME.toml` beside it that says how to use it."""

from __future__ import annotations

import difflib
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import InputError

if TYPE_CHECKING:
    import numpy as np

FILES = ("labels", "text", "tokenizer")
TEXT_PACKAGE = "minilm"  # `text` may name the optional extra instead of a file


@dataclass(frozen=True)
class TeacherModel:
    """What `read_teacher` found; docs/teachers.md says what each key means to a user.

    path:      the image encoder, `[1, 3, H, W]` float32 -> `[1, C, h, w]`.
    output:    "features", or "logits" of a closed-set segmenter: channel = index into the label list.
    mean, std: of RGB in [0, 1].
    size:      (H, W) that the model takes, or None: any whose sides are multiples of `multiple`.
    base:      long side in pixels that an image is resized to at scale 1, or None: its own.
    labels:    table of names and embeddings; text, tokenizer: encoder of any words; prompt: what a name is put into.
    """

    path: Path
    name: str
    output: str = "features"
    mean: tuple[float, ...] = (0.5, 0.5, 0.5)
    std: tuple[float, ...] = (0.5, 0.5, 0.5)
    size: tuple[int, int] | None = None
    multiple: int = 1
    labels: Path | None = None
    text: Path | str | None = None
    tokenizer: Path | None = None
    prompt: str = "{}"
    base: int | None = None

    @property
    def settings(self) -> Path:
        """The TOML beside the model."""
        return self.path.with_suffix(".toml")

    def files(self) -> list[Path]:
        """All files that the teacher's results depend on."""
        weights = self.path.with_name(self.path.name + ".data")  # where torch puts weights that do not fit one file
        named = [getattr(self, name) for name in FILES]
        return [self.path, self.settings, *filter(Path.is_file, [weights]), *(p for p in named if isinstance(p, Path))]


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
            f"{settings} is missing; write it beside the model, with at least mean, std and labels (docs/teachers.md)"
        )
    try:
        values = tomllib.loads(settings.read_text())
    except ValueError as error:
        raise InputError(f"{settings} does not parse ({error}); correct it (docs/teachers.md)") from None
    for key, value in values.items():
        _check(settings, key, value)
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    for key in FILES:
        if key in values and not (key == "text" and values[key] == TEXT_PACKAGE):
            values[key] = settings.parent / values[key]
            if not values[key].is_file():
                raise InputError(f"{values[key]} is missing; correct `{key}` in {settings}")
    found = TeacherModel(path, **({"name": path.stem} | values))
    if found.output == "features" and found.labels is None and found.text is None:
        raise InputError(f"{settings} has neither `labels` nor `text`: no label could be told; add one of them")
    if found.output == "logits" and found.labels is None:
        raise InputError(f"{settings} has no `labels`: the names of the channels are needed; add them")
    if isinstance(found.text, Path) and found.tokenizer is None:
        raise InputError(f"{settings} has `text` without `tokenizer`; add the tokenizer.json of the text encoder")
    if found.size is not None and any(side % found.multiple for side in found.size):
        raise InputError(f"{settings}: size {list(found.size)} is not a multiple of {found.multiple}; correct one")
    return found


def _is_list(value: Any, kinds: tuple[type, ...], length: int) -> bool:
    return isinstance(value, list) and len(value) == length and all(type(v) in kinds for v in value)


RULES = {
    "name": ("a word", lambda v: isinstance(v, str) and v),
    "output": ('"features" or "logits"', lambda v: v in ("features", "logits")),
    "mean": ("three numbers", lambda v: _is_list(v, (int, float), 3)),
    "std": ("three numbers above 0", lambda v: _is_list(v, (int, float), 3) and min(v) > 0),
    "size": ("[height, width] in pixels", lambda v: _is_list(v, (int,), 2) and min(v) > 0),
    "multiple": ("a whole number above 0", lambda v: type(v) is int and v > 0),
    "base": ("a whole number of pixels", lambda v: type(v) is int and v > 0),
    "labels": ("a file's name", lambda v: isinstance(v, str) and v),
    "text": ("a file's name", lambda v: isinstance(v, str) and v),
    "tokenizer": ("a file's name", lambda v: isinstance(v, str) and v),
    "prompt": ('text with a {} in it, such as "a photo of a {}"', lambda v: isinstance(v, str) and v.count("{}") == 1),
}


def _check(settings: Path, key: str, value: Any) -> None:
    if key not in RULES:
        near = difflib.get_close_matches(key, RULES, 1)
        advice = f"did you mean {near[0]}?" if near else f"known are {', '.join(RULES)}"
        raise InputError(f"{settings}: no such key {key}; {advice}")
    wanted, fits = RULES[key]
    if not fits(value):
        raise InputError(f"{settings}: {key} = {value!r} is not {wanted}; correct it")


def read_label_table(path: Path) -> tuple[list[str], np.ndarray | None]:
    """Names [L] and embeddings f32 [L, C], or None where the file holds names alone.

    Args: path: .npz with `names` and, for features, `embeddings`; or a text file of names, one a line.
    Raises: InputError naming the file and the remedy.
    """
    if path.suffix != ".npz":
        return list(read_label_set(path)), None
    from chebsplat.formats.npz import finite32, read_npz

    arrays = read_npz(path, ("names", "embeddings"), "write it again, with names and embeddings")
    listed, embeddings = arrays.get("names"), arrays.get("embeddings")
    if listed is None or listed.ndim != 1 or listed.dtype.kind != "U" or not 0 < len(set(listed)) == len(listed):
        raise InputError(f"{path}: names are missing, occur twice or are no list of words; write it again")
    names = [str(name) for name in listed]
    if embeddings is None:
        return names, None
    rows = finite32(embeddings)
    if rows is None or rows.ndim != 2 or len(rows) != len(names) or not rows.size:
        raise InputError(
            f"{path}: embeddings {embeddings.dtype} {embeddings.shape} do not fit {len(names)} names, or are not "
            "finite; write it again"
        )
    return names, rows


def read_label_set(path: Path) -> dict[str, list[str]]:
    """Names in order, each with the words that mean it: itself, then its synonyms.

    The file is plain text: `name` or `name: synonym, synonym` a line; `#` begins a comment.
    Raises: InputError naming the file, the line and the remedy.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputError(f"{path} is missing; correct the file of labels") from None
    except (OSError, UnicodeDecodeError):
        raise InputError(f"{path} is not a text file; labels are plain text, one name a line") from None
    found: dict[str, list[str]] = {}
    for number, line in enumerate(lines, start=1):
        name, _, others = (part.strip() for part in line.partition("#")[0].partition(":"))
        if not name and not others:
            continue
        if not name or name in found:
            raise InputError(f"{path}, line {number}: a name is {'given twice' if name else 'missing'}; correct it")
        words = [name, *(word.strip() for word in others.split(",") if word.strip())]
        found[name] = list(dict.fromkeys(words))
    if not found:
        raise InputError(f"{path} holds no label; write one name a line")
    return found
