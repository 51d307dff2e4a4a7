"""Embeddings of words, from the teacher's own table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from chebsplat.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.teacher_model import TeacherModel


def text_embeddings(names: list[str], teacher: TeacherModel) -> np.ndarray:
    """Unit rows f32 [L, C]. Raises InputError naming a word that the table does not know."""
    import numpy as np

    from chebsplat.formats.teacher_model import read_label_table

    assert teacher.labels is not None
    known, embeddings = read_label_table(teacher.labels)
    if embeddings is None:
        raise InputError(f"{teacher.labels} has no embeddings; write it again")
    row = {name.lower().replace("_", " "): k for k, name in enumerate(known)}
    absent = [name for name in names if name.lower().replace("_", " ") not in row]
    if absent:
        raise InputError(f"{teacher.labels} does not know {', '.join(absent)}; add them to the table")
    found = np.stack([embeddings[row[name.lower().replace("_", " ")]] for name in names])
    return found / np.linalg.norm(found, axis=1, keepdims=True)
