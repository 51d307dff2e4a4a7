"""The contract of an exported encoder: what to feed, in which units, and what comes out."""

from __future__ import annotations

from typing import Any

POSITIONS = {  # units and meaning
    "region": ("region radii", "(mean - centre) / radius"),
    "center": ("scene extents", "(mean - median) / extent, the 0.95 quantile of largest distances along an axis"),
    "both": ("region radii, scene extents", "(mean - centre) / radius, then (mean - median) / extent"),
}


def contract(encoder: Any, config: dict[str, Any]) -> dict[str, Any]:
    """Inputs, outputs and settings of the graphs that the onnx stage writes, as JSON-able values.

    Args:
      encoder: the `encoder.RegionEncoder`.
      config:  the sections `describe` and `train` that the scene was trained with.
    """
    describe, train = config["describe"], config["train"]
    described = train["albo"]
    context = train["context"] == "features"
    n_described = encoder.n_inputs - encoder.n_channels * context
    first = [f"a descriptor of {n_described} values, [angles, degrees] flattened, as computed (Eqs 4-6)"] * described
    first += [f"the Gaussian's {encoder.n_channels} semantic features before fusion"] * context
    inputs = {
        "inputs": array(
            "float32",
            ["regions", "members", encoder.n_inputs],
            "none",
            ", then ".join(first) or "nothing: the encoder sees positions alone",
        ),
        "positions": array("float32", ["regions", "members", encoder.n_positions], *POSITIONS[train["position"]]),
        "mask": array(
            "bool", ["regions", "members"], "", "true where a member exists; what stands elsewhere is unread"
        ),
    }
    c = encoder.n_channels
    fusion = {
        "features": array("float32", ["gaussians", c], "none", "semantic features before fusion"),
        "encodings": array("float32", ["regions", c], "none", "the encoder's output"),
        "cover": array("int64", ["gaussians", "covers"], "", "regions that reach a Gaussian, nearest first; -1: none"),
        "means": array("float32", ["gaussians", 3], "scene units", "centres of the Gaussians"),
        "centers": array("float32", ["regions", 3], "scene units", "centre of the Gaussian that a region is built on"),
        "quats": array("float32", ["regions", 4], "none", "its rotation, wxyz, of any length"),
        "scales": array("float32", ["regions", 3], "scene units", "its standard deviations, not their logarithms"),
        "radius": array("float32", [], "scene units", "of all regions"),
    }
    return {
        "encoder": {
            "files": ["encoder.onnx", "encoder.int8.onnx"],
            "inputs": inputs,
            "outputs": {"encodings": array("float32", ["regions", c], "none", "one semantic vector a region (Eq 7)")},
            "normalization": "none outside the graph: it begins by standardising each input with constants of its own",
        },
        "fusion": {
            "files": ["fusion.onnx"],
            "inputs": fusion,
            "outputs": {
                "fused": array("float32", ["gaussians", c], "none", "features after propagation and gate (Eqs 8-10)"),
                "gate": array("float32", ["gaussians", c], "none", "the share of `features`; 1 where nothing covers"),
            },
            "normalization": "none",
        },
        "settings": {
            "describe": describe,
            "n_covers": train["n_covers"],
            "described": described,
            "context": context,
            "position": train["position"],
            "n_inputs": encoder.n_inputs,
            "n_channels": c,
        }
        | encoder.settings,
    }


def array(dtype: str, shape: list[str | int], units: str, meaning: str) -> dict[str, Any]:
    """One input or output; a named dimension may have any size from 1."""
    return {"dtype": dtype, "shape": shape, "units": units, "meaning": meaning}
