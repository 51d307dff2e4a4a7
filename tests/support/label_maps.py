"""Label maps as people have them: writers of a view's map, by its path without an ending and its
classes [H, W]. Of every table the last row is for -1, no class.
"""

import numpy as np
from PIL import Image


def pictures(table, kind=np.uint8, ending=".png", form="PNG"):
    """Pictures of ids, or of colours."""

    def write(path, classes):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.array(table)[classes].astype(kind)).save(f"{path}{ending}", format=form)

    return write


def arrays(table, kind=np.int64, axes=None):
    """Arrays of ids, or of scores by class, whose axes are put into the order `axes`."""

    def write(path, classes):
        values = np.array(table)[classes].astype(kind)
        np.save(f"{path}.npy", values if axes is None else values.transpose(axes))

    return write


def masks(names, form="png", swapped=False):
    """One mask for each class that a view shows: VIEW/CLASS, or CLASS/VIEW; of JPEG a pixel fills a
    block.
    """
    block = np.ones((16, 16), bool) if form == "jpg" else np.ones((1, 1), bool)

    def write(path, classes):
        for k in set(classes[classes >= 0].tolist()):
            place = path.parent / names[k] / path.name if swapped else path / names[k]
            pictures([0, 255], ending=f".{form}", form=None)(
                place, np.kron(classes == k, block).astype(int)
            )

    return write
