"""Labels to decode a teacher's maps to, and the vectors that a scene learns of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.teacher_model import read_label_set, read_label_table
from chebsplat.labels.decode import IGNORE, class_codes, decode
from chebsplat.labels.names import joined, lacking, rows_of
from chebsplat.stages.teacher_models.text_encoder import text_embeddings

if TYPE_CHECKING:
    from chebsplat.formats.channels import ChannelMap
    from chebsplat.formats.teacher_model import TeacherModel

# common contents of rooms: the labels where neither the source nor the user names classes
IN_ROOMS = (
    "wall", "floor", "ceiling", "window", "door", "curtain", "blind", "rug", "table", "desk",
    "chair", "armchair", "sofa", "stool", "bed", "cabinet", "wardrobe", "chest of drawers", "shelf",
    "bookcase", "counter", "lamp", "picture", "mirror", "clock", "plant", "vase", "cushion",
    "pillow", "blanket", "towel", "basket", "bin", "box", "book", "paper", "bottle", "cup", "bowl",
    "plate", "monitor", "television", "keyboard", "computer", "sink", "toilet", "bathtub", "shower",
    "oven", "refrigerator", "microwave", "radiator", "stairs", "person",
)  # fmt: skip
# classes of ADE20K and Cityscapes that no room holds
OUTDOORS = (
    "airplane", "animal", "boat", "bridge", "building", "bus", "car", "dirt track", "earth",
    "fence", "field", "fountain", "grandstand", "grass", "hill", "house", "hovel", "lake", "land",
    "motorcycle", "mountain", "path", "pier", "river", "road", "rock", "sand", "sea", "ship",
    "sidewalk", "sky", "skyscraper", "streetlight", "tent", "terrain", "tower", "traffic light",
    "traffic sign", "train", "tree", "truck", "van", "vegetation", "water", "waterfall",
)  # fmt: skip
# of a room where OUTDOORS have at most this share: nine captures of rooms have .01 to .12
IN_A_ROOM = 0.3
LEAST = 12  # of these words in a teacher's table; with fewer all words of the table are labels


@dataclass
class LabelSpace:
    """names [L]; embeddings f32 [L, d]; split: from a map [h, w, C] to features [h, w, d], labels
    and confidence [h, w]; left_out: classes of the teacher that the scene does without.
    """

    names: list[str]
    embeddings: np.ndarray
    split: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
    left_out: Sequence[str] = ()


def label_set(
    teacher: TeacherModel, file: str | None, class_names: list[str] | None
) -> dict[str, list[str]]:
    """Names in order with their synonyms: of `file`, else of the capture, else of IN_ROOMS.

    Choices: of IN_ROOMS those in the teacher's table, which may have thousands of nouns; where
      these are fewer than LEAST, all of the table.
    """
    if file:
        return read_label_set(Path(file))
    if class_names:
        return {name: [name] for name in class_names}
    if teacher.labels is None:
        raise ConfigError(
            f"no labels to ask for: the capture names no classes and {teacher.settings} has no "
            "`labels`; give teacher.labels, a text file with one name a line"
        )
    table = read_label_table(teacher.labels)[0]
    absent = lacking(IN_ROOMS, table)
    common = [name for name in IN_ROOMS if name not in absent]
    return {name: [name] for name in (common if len(common) >= LEAST else table)}


def open_vocabulary(
    teacher: TeacherModel,
    labels: dict[str, list[str]],
    n_channels: int,
    channels: ChannelMap | None,
) -> LabelSpace:
    """The space of a teacher of `n_channels` features.

    Raises: InputError where embeddings or the channel map have other channels.
    Choices: a label's vector is the normalised mean of the unit embeddings of its words. Labels and
      confidence are decoded in the teacher's own channels.
    """
    from chebsplat.stages.teacher_models.image_encoder import unit

    words = list(dict.fromkeys(word for group in labels.values() for word in group))
    vectors = dict(zip(words, unit(text_embeddings(words, teacher), -1), strict=True))
    own = unit(
        np.stack([np.mean([vectors[word] for word in group], 0) for group in labels.values()]), -1
    )
    if own.shape[1] != n_channels:
        raise InputError(
            f"{teacher.path} gives {n_channels} channels, its text embeddings have {own.shape[1]} "
            f"({teacher.labels or teacher.text}); correct `labels` or `text` in {teacher.settings}"
        )
    if channels is not None and len(channels.matrix) != n_channels:
        raise InputError(
            f"the channel map is of {len(channels.matrix)} channels ({channels.teacher}), "
            f"{teacher.path} has {n_channels}; pass the one of this teacher"
        )

    def split(maps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        features = maps if channels is None else channels.apply(maps)
        return features, *decode(maps, own)

    return LabelSpace(list(labels), own if channels is None else channels.embed(own), split)


def closed_set(
    teacher: TeacherModel,
    labels: dict[str, list[str]] | None,
    shares: np.ndarray,
    n_codes: int,
) -> LabelSpace:
    """The space of a segmenter.

    Args: labels: of a file: classes that are words of one label become that label; the others keep
      their own names. shares [C]: mean probability of each class in some views.
    Raises: InputError where names and channels differ in number, or a label has no class.
    Choices: a pixel's feature is the unit mean of the class codes (`chebsplat.labels.decode`),
      weighted by its probabilities, so that training is as for features; its label is the likeliest
      class, its confidence that class's probability. Where the views are of a room, OUTDOORS that
      the file does not name are left out; their pixels get the next likeliest class.
    """
    from chebsplat.stages.teacher_models.image_encoder import unit

    assert teacher.labels is not None  # `read_teacher` checks it
    classes = read_label_table(teacher.labels)[0]
    if len(classes) != len(shares):
        raise InputError(
            f"{teacher.path} gives {len(shares)} channels, {teacher.labels} names {len(classes)} "
            "classes; name every channel in order"
        )
    label_of = {joined(word): name for name, group in (labels or {}).items() for word in group}
    named = [label_of.get(joined(word), word) for word in classes]
    absent = [name for name in labels or {} if name not in named]
    if absent:
        raise InputError(
            f"no class of {teacher.labels} is called {absent[0]} or one of its "
            "synonyms; correct the file"
        )
    elsewhere = [row >= 0 and name not in (labels or {})
                 for row, name in zip(rows_of(named, OUTDOORS), named, strict=True)]  # fmt: skip
    in_a_room = float(shares[elsewhere].sum()) < IN_A_ROOM
    left_out = [name for name, out in zip(named, elsewhere, strict=True) if out and in_a_room]
    names = [name for name in dict.fromkeys(named) if name not in left_out]
    merge = np.array([[name == of for name in names] for of in named], np.float32)
    codes = class_codes(names, n_codes)

    def split(maps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        of_names = maps @ merge
        confidence = of_names.max(-1)
        labels = np.where(confidence > 0, of_names.argmax(-1), IGNORE).astype(np.int16)
        return unit(of_names @ codes, -1), labels, confidence

    return LabelSpace(names, codes, split, left_out)
