"""The point encoder as an ONNX graph (see `region_graph`), and the contracts of all our ONNX files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from onnx import ModelProto, TensorProto

from chebsplat.shape.point_inputs import N_OWN, RADII
from chebsplat.stages.shape_models.region_graph import Graph, number, whole

if TYPE_CHECKING:
    from chebsplat.shape.encoder import Standardize
    from chebsplat.shape.point_encoder import PointEncoder, Scale


def point_model(encoder: PointEncoder) -> ModelProto:
    """`PointEncoder.answers`: the arrays of `PointInputs`, neighbours as int64 -> answers [points, C]."""
    n_scales, n_channels = encoder.settings["n_scales"], encoder.settings["n_channels"]
    n_descriptors, kind = encoder.settings["n_descriptors"], TensorProto.FLOAT
    graph = Graph(
        own=(kind, ["points", N_OWN]),
        means=(kind, ["points", 3]),
        normals=(kind, ["points", 3]),
        descriptors=(kind, ["points", n_descriptors]),
        neighbors=(TensorProto.INT64, ["points", n_scales, "neighbors"]),
    )
    parts = [_standardized(graph, "own", encoder.norm_own)]
    if n_descriptors:
        standard = _standardized(graph, "descriptors", encoder.norm_descriptors)
        parts.append(graph.add("MatMul", standard, encoder.components))
    first, _, second = encoder.embed
    embedded = graph.linear(_silu(graph, graph.linear(graph.add("Concat", *parts, axis=-1), first)), second)
    pooled = [embedded]
    for index, scale in enumerate(encoder.scales.children()):
        rows = graph.add("Gather", "neighbors", whole(index), axis=1)
        pooled.append(_pooled(graph, scale, embedded, graph.add("Squeeze", rows, whole(1)), RADII[index]))  # type: ignore[arg-type]
    answers = graph.add("Concat", *pooled, axis=-1)
    for layer in list(encoder.decode)[:-1:2]:
        answers = _silu(graph, graph.linear(answers, layer))
    answers = graph.linear(answers, encoder.decode[-1])
    return graph.model("points", answers=(answers, ["points", n_channels]))


def _silu(graph: Graph, values: str) -> str:
    return graph.add("Mul", values, graph.add("Sigmoid", values))


def _standardized(graph: Graph, values: str, norm: Standardize) -> str:
    standard = graph.add("Div", graph.add("Sub", values, norm.mean), norm.deviation)
    return graph.add("Clip", standard, number(-5), number(5))


def _pooled(graph: Graph, scale: Scale, embedded: str, neighbors: str, radius: float) -> str:
    """`Scale.forward`: [points, 2 hidden]."""
    rows = graph.add("Max", neighbors, whole(0))
    there = graph.add("Unsqueeze", graph.add("GreaterOrEqual", neighbors, whole(0)), whole(2))
    own = graph.add("Unsqueeze", graph.linear(embedded, scale.point), whole(1))
    others = graph.add("Gather", graph.add("MatMul", embedded, scale.neighbor.weight.T), rows)
    lying = graph.add("MatMul", _relative(graph, rows, radius), scale.relative.weight.T)
    tokens = _silu(graph, graph.add("Add", graph.add("Add", own, others), lying))
    tokens = _silu(graph, graph.linear(tokens, scale.mix))
    count = graph.add("ReduceSum", graph.add("Cast", there, to=TensorProto.FLOAT), whole(1), keepdims=0)
    total = graph.add("ReduceSum", graph.add("Where", there, tokens, number(0)), whole(1), keepdims=0)
    mean = graph.add("Div", total, graph.add("Max", count, number(1)))
    largest = graph.add("ReduceMax", graph.add("Where", there, tokens, number(-1e9)), whole(1), keepdims=0)
    largest = graph.add("Where", graph.add("Greater", count, number(0)), largest, number(0))
    return graph.add("Concat", mean, largest, axis=-1)


def _relative(graph: Graph, rows: str, radius: float) -> str:
    """`point_encoder.relative`: [points, K, 10]."""

    def length(values: str) -> str:
        return graph.add("ReduceL2", values, whole(-1), keepdims=1)

    def dot(a: str, b: str) -> str:
        return graph.add("ReduceSum", graph.add("Mul", a, b), whole(-1), keepdims=1)

    def part(values: str, start: int, stop: int) -> str:
        return graph.add("Slice", values, whole(start), whole(stop), whole(-1))

    offset = graph.add("Sub", graph.add("Gather", "means", rows), graph.add("Unsqueeze", "means", whole(1)))
    offset = graph.add("Div", offset, number(radius))
    normal, others = graph.add("Unsqueeze", "normals", whole(1)), graph.add("Gather", "normals", rows)
    along = dot(offset, normal)
    across = graph.add("Sub", offset, graph.add("Mul", along, normal))
    rise = graph.add("Sub", part(others, 2, 3), part(normal, 2, 3))
    sizes = length(offset), length(part(offset, 0, 2)), graph.add("Abs", part(offset, 2, 3))
    return graph.add("Concat", offset, *sizes, along, length(across), dot(normal, others), rise, axis=-1)


def point_contract(encoder: PointEncoder) -> dict[str, Any]:
    """What to feed the graph, in which units, and what comes out, as JSON-able values."""
    n, scales, settings = "points", encoder.settings["n_scales"], encoder.settings
    radii = ", ".join(f"{r:g}" for r in RADII[:scales])
    own = "height above the floor; normal . up and its size; ratios of the local axes; log of the longest"
    return {
        "inputs": {
            "own": array("float32", [n, N_OWN], "metres, none, none, none, none, log of metres", own),
            "means": array("float32", [n, 3], "metres", "where points lie, z up"),
            "normals": array("float32", [n, 3], "none", "unit, towards a camera"),
            "descriptors": array("float32", [n, settings["n_descriptors"]], "none", f"at {radii} metres (Eqs 4-6)"),
            "neighbors": array("int64", [n, scales, "neighbors"], "", f"points within {radii} m; -1: none"),
        },
        "outputs": {
            "answers": array("float32", [n, settings["n_channels"]], "none", "one semantic vector a point (Eq 7)")
        },
        "normalization": "none outside the graph",
        "settings": settings,
    }


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
    return {
        "encoder": {
            "files": ["encoder.onnx", "encoder.int8.onnx"],
            "inputs": inputs,
            "outputs": {"encodings": array("float32", ["regions", c], "none", "one semantic vector a region (Eq 7)")},
            "normalization": "none outside the graph: it begins by standardising each input with constants of its own",
        },
        "fusion": _fusion(c),
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


def _fusion(c: int) -> dict[str, Any]:
    """The part of the contract on the fusion of features of c channels."""
    inputs = {
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
        "files": ["fusion.onnx"],
        "inputs": inputs,
        "outputs": {
            "fused": array("float32", ["gaussians", c], "none", "features after propagation and gate (Eqs 8-10)"),
            "gate": array("float32", ["gaussians", c], "none", "the share of `features`; 1 where nothing covers"),
        },
        "normalization": "none",
    }


def array(dtype: str, shape: list[str | int], units: str, meaning: str) -> dict[str, Any]:
    """One input or output; a named dimension may have any size from 1."""
    return {"dtype": dtype, "shape": shape, "units": units, "meaning": meaning}
