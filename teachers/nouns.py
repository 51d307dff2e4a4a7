"""`make nouns`: the embedded teacher's table of words, from nouns.txt by the sentence model of the extra `text`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from chebsplat.formats.teacher_model import read_label_set
from chebsplat.stages.teacher_models.text_encoder import sentence_embeddings

NOUNS = Path(__file__).with_name("nouns.txt")
TABLE = Path(__file__).with_name("embedded.npz")


def table() -> tuple[list[str], np.ndarray]:
    """Names [L] and their embeddings f16 [L, 384], unit to rounding."""
    names = list(read_label_set(NOUNS))
    return names, sentence_embeddings(names).astype(np.float16)


def main() -> None:
    """Write the table of nouns and their embeddings."""
    try:
        names, embeddings = table()
    except ModuleNotFoundError as error:
        sys.exit(f"nouns: install the extra first: pip install -e '.[text]' ({error})")
    np.savez_compressed(TABLE, names=np.array(names), embeddings=embeddings)
    print(TABLE)


if __name__ == "__main__":
    main()
