"""3DGS PLY files: the 62-float layout that viewers load, trimmed to the SH bands in use."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chebsplat.errors import InputError

REST = {0: 0, 1: 3, 2: 8, 3: 15}  # coefficients beyond band 0, by degree
_FIXED = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
_TAIL = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def write_ply(path: Path, parameters: dict[str, np.ndarray], degree: int, labels: np.ndarray | None = None) -> None:
    """Write raw parameters (`formats.gaussians.Gaussians.parameters`) as a binary little-endian 3DGS PLY.

    Args:
      degree: highest band to write; `f_rest` is channel-major and shorter below 3.
      labels: [N] class ids, appended as `ushort label` (65535 = none) after `rot_3`.
    Choices: normals are written as zeros, since some loaders hard-code their presence.
    """
    from plyfile import PlyData, PlyElement

    n, n_rest = len(parameters["means"]), REST[degree]
    columns = [(name, "<f4") for name in (*_FIXED, *(f"f_rest_{i}" for i in range(3 * n_rest)), *_TAIL)]
    extra = [("label", "<u2")] if labels is not None else []
    rows = np.zeros(n, dtype=columns + extra)
    values = np.concatenate(
        [
            parameters["means"],
            np.zeros((n, 3), np.float32),
            parameters["sh0"][:, 0],
            parameters["shN"][:, :n_rest].transpose(0, 2, 1).reshape(n, -1),
            parameters["logit_opacities"][:, None],
            parameters["log_scales"],
            parameters["quats"],
        ],
        axis=1,
    )
    for index, (name, _) in enumerate(columns):
        rows[name] = values[:, index]
    if labels is not None:
        rows["label"] = np.where(labels < 0, 65535, labels)
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))


def read_ply(path: Path) -> tuple[dict[str, np.ndarray], int, np.ndarray | None]:
    """Raw parameters, file degree, and labels where the file has them. Normals are optional.

    Raises: InputError naming the file: not a PLY, truncated, not a 3DGS layout, or non-finite values.
    """
    from plyfile import PlyData, PlyParseError

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is missing; export the scene again")
    try:
        vertex = PlyData.read(str(path))["vertex"]
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError, MemoryError) as error:
        raise InputError(f"{path} is not a readable PLY ({error}); export the scene again") from None
    names = [p.name for p in vertex.properties]
    absent = [name for name in (*_FIXED[:3], *_FIXED[6:], *_TAIL) if name not in names]
    if absent:
        raise InputError(f"{path} has no property {absent[0]}: not an uncompressed 3DGS PLY; convert it first")
    n_rest = sum(name.startswith("f_rest_") for name in names)
    degree = next((d for d, k in REST.items() if 3 * k == n_rest), None)
    if degree is None:
        raise InputError(f"{path} has {n_rest} f_rest properties; 0, 9, 24 or 45 are possible")

    def block(wanted: list[str]) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], np.float32) for name in wanted], 1)

    n = len(vertex.data)
    rest = block([f"f_rest_{i}" for i in range(n_rest)]) if n_rest else np.zeros((n, 0), np.float32)
    shN = np.zeros((n, 15, 3), np.float32)
    shN[:, : n_rest // 3] = rest.reshape(n, 3, n_rest // 3).transpose(0, 2, 1)
    parameters = {
        "means": block(["x", "y", "z"]),
        "log_scales": block(_TAIL[1:4]),
        "quats": block(_TAIL[4:]),
        "logit_opacities": block(["opacity"])[:, 0],
        "sh0": block(_FIXED[6:])[:, None],
        "shN": shN,
    }
    for name, values in parameters.items():
        if not np.isfinite(values).all():
            raise InputError(f"{path}: {name} holds non-finite values; export the scene again")
    labels = np.asarray(vertex["label"]).astype(np.int32) if "label" in names else None
    if labels is not None:
        labels = np.where(labels == 65535, -1, labels)
    return parameters, degree, labels
