"""Count the Gaussians of each class: python examples/count_labels.py office0.spz (or .sog, .glb)"""

import json
import sys

import numpy as np


def labels_of(file: str) -> tuple[np.ndarray, list[str]]:
    """The class of each Gaussian in the file's order, -1 for none, and the names of classes."""
    if not file.endswith(".glb"):
        told = np.load(f"{file}.labels.npz")
        return told["labels"][told["meanings"]], told["names"].tolist()
    data = np.fromfile(file, np.uint8)
    end = 20 + int(data[12:16].view("<u4")[0])
    glb = json.loads(data[20:end].tobytes())
    told = glb["extensions"]["EXT_structural_metadata"]
    column = told["propertyTables"][0]["properties"]["label"]["values"]
    row = glb["meshes"][0]["primitives"][0]["attributes"]["_FEATURE_ID_0"]
    places = [(v["byteOffset"], v["byteLength"]) for v in glb["bufferViews"]]
    labels, rows = (data[end + 8 :][places[k][0] :][: places[k][1]] for k in (column, row))
    names = [entry["name"] for entry in told["schema"]["enums"]["label"]["values"][1:]]
    return labels.view("<i4")[rows.view("<f4").astype(int)], names


if __name__ == "__main__":
    classes, classes_names = labels_of(sys.argv[1])
    counts = np.bincount(classes + 1, minlength=len(classes_names) + 1)
    for name, count in zip(["none", *classes_names], counts, strict=True):
        print(f"{name:20s}{count:10,}")
