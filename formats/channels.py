"""`channels/2`: the linear map from a teacher's channels to the fewer of a trained scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.formats.record import Array, Record


@dataclass
class ChannelMap(Record):
    """The linear map from a teacher's C channels to d, one for all scenes (`labels.channels`).

    matrix:  f32 [C, d] orthonormal columns, of falling weight.
    inverse: f32 [d, C], back to the teacher's channels.
    energy:  f32 [C] share of the reference's squared length that the first k + 1 directions hold.
    teacher: its name.
    notes:   the teacher's digest, what the reference was, numbers of its pixels and of the
      vocabulary's words.
    """

    SCHEMA: ClassVar[str] = "chebsplat.channels/2"
    matrix: Annotated[np.ndarray, Array("float32", ("teacher_channel", "channel"))]
    inverse: Annotated[np.ndarray, Array("float32", ("channel", "teacher_channel"))]
    energy: Annotated[np.ndarray, Array("float32", ("teacher_channel",))]
    teacher: str
    notes: dict[str, Any]

    def apply(self, features: np.ndarray) -> np.ndarray:
        """Features [..., C] -> f32 [..., d]."""
        mapped: np.ndarray = np.asarray(features, np.float32) @ self.matrix
        return mapped

    def embed(self, embeddings: np.ndarray) -> np.ndarray:
        """Unit embeddings [L, C] of words -> f32 [L, d].

        Choices: not made unit again, so that an inner product with mapped features is the teacher's
          own; unit rows would favour the words that the reference shows least.
        """
        embedded: np.ndarray = np.asarray(embeddings, np.float32) @ self.matrix
        return embedded

    def restore(self, features: np.ndarray) -> np.ndarray:
        """Mapped features [..., d] -> f32 [..., C]."""
        restored: np.ndarray = np.asarray(features, np.float32) @ self.inverse
        return restored
