"""The point encoder as an ONNX graph, operation by operation as in torch, and its contract.

Written by hand: torch's own exporter traces for 20 s and more. The stage `onnx` compares it with
torch at every export.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, checker, helper, numpy_helper

from chebsplat.shape.point_inputs import N_OWN, RADII

if TYPE_CHECKING:
    from torch.nn import LayerNorm

    from chebsplat.formats.knowledge import Knowledge
    from chebsplat.shape.point_encoder import PointEncoder, Scale, Standardize

OPSET = 18
Value = Any  # the name of a node's output, a torch tensor, or a NumPy constant


class Graph:
    """A graph under construction. Dimensions are numbers, or names, of any size from 1."""

    def __init__(self, **inputs: tuple[int, list[int | str]]):
        """inputs: by name, element type and shape."""
        self.inputs = [
            helper.make_tensor_value_info(name, *entry) for name, entry in inputs.items()
        ]
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []

    def add(self, operator: str, *inputs: Value, **attributes: Any) -> str:
        """One node with one output; gives its name."""
        output = f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(
            helper.make_node(operator, [self._name(v) for v in inputs], [output], **attributes)
        )
        return output

    def _name(self, value: Value) -> str:
        if isinstance(value, str):
            return value
        array = value if isinstance(value, np.ndarray) else value.detach().numpy()
        name = f"constant_{len(self.constants)}"
        self.constants.append(
            numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name)
        )
        return name

    def linear(self, values: Value, layer: Any) -> str:
        """values Wᵀ + b of an `nn.Linear`."""
        return self.add("Add", self.add("MatMul", values, layer.weight.T), layer.bias)

    def model(self, name: str, **outputs: tuple[str, list[int | str]]) -> ModelProto:
        """The checked model. outputs: by name, a float32 value and its shape."""
        for output, (value, _) in outputs.items():
            self.nodes.append(helper.make_node("Identity", [value], [output]))
        entries = [
            helper.make_tensor_value_info(o, TensorProto.FLOAT, shape)
            for o, (_, shape) in outputs.items()
        ]
        graph: GraphProto = helper.make_graph(
            self.nodes, name, self.inputs, entries, self.constants
        )
        opsets = [helper.make_opsetid("", OPSET)]
        version = helper.find_min_ir_version_for(opsets)
        model = helper.make_model(
            graph, opset_imports=opsets, ir_version=version, producer_name="chebsplat"
        )
        checker.check_model(model)
        return model


def number(value: float) -> np.ndarray:
    """A float32 constant []."""
    return np.array(value, np.float32)


def whole(*values: int) -> np.ndarray:
    """An int64 constant [n]."""
    return np.array(values, np.int64)


def point_model(encoder: PointEncoder, answers: np.ndarray) -> ModelProto:
    """The encoder, then the map `answers` [p, d]: from arrays of `PointInputs` to [points, d]."""
    n_scales, n_descriptors = encoder.settings["n_scales"], encoder.settings["n_descriptors"]
    kind = TensorProto.FLOAT
    inputs: dict[str, tuple[int, list[int | str]]] = {
        "own": (kind, ["points", N_OWN]),
        "means": (kind, ["points", 3]),
        "normals": (kind, ["points", 3]),
        "descriptors": (kind, ["points", n_descriptors]),
        "neighbors": (TensorProto.INT64, ["points", n_scales, "neighbors"]),
    }
    graph = Graph(
        **{name: entry for name, entry in inputs.items() if name != "descriptors" or n_descriptors}
    )
    parts = [_standardized(graph, "own", encoder.norm_own)]
    if n_descriptors:
        standard = _standardized(graph, "descriptors", encoder.norm_descriptors)
        parts.append(graph.add("MatMul", standard, encoder.components))
    first, _, second = encoder.embed
    embedded = graph.linear(
        _silu(graph, graph.linear(graph.add("Concat", *parts, axis=-1), first)), second
    )
    pooled = [embedded]
    for index, scale in enumerate(encoder.scales.children()):
        rows = graph.add("Gather", "neighbors", whole(index), axis=1)
        rows = graph.add("Squeeze", rows, whole(1))
        pooled.append(
            _attended(graph, scale, embedded, rows, RADII[index])  # type: ignore[arg-type]
        )
    context = decoded = graph.add("Concat", *pooled, axis=-1)
    for layer in list(encoder.decode)[::2]:
        decoded = _silu(graph, graph.linear(decoded, layer))
    features, constant = answers[:-1], answers[-1]  # the last feature is 1
    prediction = graph.add(
        "Add",
        graph.add("MatMul", graph.add("Concat", context, decoded, axis=-1), features),
        constant,
    )
    return graph.model("points", answers=(prediction, ["points", answers.shape[1]]))


def _silu(graph: Graph, values: str) -> str:
    return graph.add("Mul", values, graph.add("Sigmoid", values))


def _standardized(graph: Graph, values: str, norm: Standardize) -> str:
    standard = graph.add("Div", graph.add("Sub", values, norm.mean), norm.deviation)
    return graph.add("Clip", standard, number(-5), number(5))


def _attended(graph: Graph, scale: Scale, embedded: str, neighbors: str, radius: float) -> str:
    """`Scale.forward`: [points, 2 hidden]."""
    rows = graph.add("Max", neighbors, whole(0))
    there = graph.add("Unsqueeze", graph.add("GreaterOrEqual", neighbors, whole(0)), whole(2))
    own = graph.add("Unsqueeze", graph.linear(embedded, scale.point), whole(1))
    others = graph.add("Gather", graph.add("MatMul", embedded, scale.neighbor.weight.T), rows)
    before, _, after = scale.place
    lying = graph.add(
        "MatMul", _silu(graph, graph.linear(_relative(graph, rows, radius), before)), after.weight.T
    )
    tokens = graph.add("Add", graph.add("Add", own, others), lying)
    fed = _fed(graph, scale, tokens)
    count = graph.add(
        "ReduceSum", graph.add("Cast", there, to=TensorProto.FLOAT), whole(1), keepdims=0
    )
    total = graph.add("ReduceSum", graph.add("Where", there, fed, number(0)), whole(1), keepdims=0)
    mean = graph.add("Div", total, graph.add("Max", count, number(1)))
    if not scale.attends:
        largest = graph.add(
            "ReduceMax", graph.add("Where", there, fed, number(-1e9)), whole(1), keepdims=0
        )
        largest = graph.add("Where", graph.add("Greater", count, number(0)), largest, number(0))
        return graph.add("Concat", largest, mean, axis=-1)
    normal, query, learned = (
        _normalized(graph, tokens, scale.norm),
        scale.project_query(),
        scale.norm(scale.token),
    )
    scores = graph.add("Where", there, graph.add("MatMul", normal, query), number(-1e9))
    itself = graph.add(
        "Expand", (learned @ query)[None, None], _sizes(graph, rows, 1, query.shape[1])
    )
    shares = graph.add("Softmax", graph.add("Concat", scores, itself, axis=1), axis=1)
    of_others = graph.add("Slice", shares, whole(0), whole(-1), whole(1))
    of_itself = graph.add("Slice", shares, whole(-1), whole(2**31), whole(1))
    of_others, of_itself = (
        graph.add("Transpose", of, perm=[0, 2, 1]) for of in (of_others, of_itself)
    )
    gathered = graph.add(
        "Add", graph.add("MatMul", of_others, normal), graph.add("Mul", of_itself, learned)
    )
    gathered = graph.add("Reshape", gathered, whole(-1, query.shape[0] * query.shape[1]))
    token = graph.add(
        "Add", graph.add("MatMul", gathered, scale.project_values().flatten(0, 1)), scale.token
    )
    return graph.add("Concat", _fed(graph, scale, token), mean, axis=-1)


def _sizes(graph: Graph, rows: str, *others: int) -> str:
    """The shape of one entry a point: [points, ...]."""
    points = graph.add("Slice", graph.add("Shape", rows), whole(0), whole(1))
    return graph.add("Concat", points, whole(*others), axis=0)


def _normalized(graph: Graph, values: str, norm: LayerNorm) -> str:
    return graph.add(
        "LayerNormalization", values, norm.weight, norm.bias, axis=-1, epsilon=norm.eps
    )


def _fed(graph: Graph, scale: Scale, values: str) -> str:
    """Tokens after the block's feed-forward."""
    before, _, after = scale.feed
    fed = _silu(graph, graph.linear(_normalized(graph, values, scale.norm_after), before))
    return graph.add("Add", values, graph.linear(fed, after))


def _relative(graph: Graph, rows: str, radius: float) -> str:
    """`point_encoder.relative`: [points, K, 10]."""

    def length(values: str) -> str:
        return graph.add("ReduceL2", values, whole(-1), keepdims=1)

    def dot(a: str, b: str) -> str:
        return graph.add("ReduceSum", graph.add("Mul", a, b), whole(-1), keepdims=1)

    def part(values: str, start: int, stop: int) -> str:
        return graph.add("Slice", values, whole(start), whole(stop), whole(-1))

    offset = graph.add(
        "Sub", graph.add("Gather", "means", rows), graph.add("Unsqueeze", "means", whole(1))
    )
    offset = graph.add("Div", offset, number(radius))
    normal = graph.add("Unsqueeze", "normals", whole(1))
    others = graph.add("Gather", "normals", rows)
    along = dot(offset, normal)
    across = graph.add("Sub", offset, graph.add("Mul", along, normal))
    rise = graph.add("Sub", part(others, 2, 3), part(normal, 2, 3))
    sizes = length(offset), length(part(offset, 0, 2)), graph.add("Abs", part(offset, 2, 3))
    return graph.add(
        "Concat", offset, *sizes, along, length(across), dot(normal, others), rise, axis=-1
    )


def point_contract(encoder: PointEncoder, knowledge: Knowledge) -> dict[str, Any]:
    """Inputs and outputs of the graph, with shapes, units and meaning, as JSON-able values."""
    n, scales, settings = "points", encoder.settings["n_scales"], encoder.settings
    radii = ", ".join(f"{r:g}" for r in RADII[:scales])
    own = (
        "height above the floor; normal . up and its size; ratios of the local axes; log of the "
        "longest"
    )
    return {
        "inputs": {
            "own": array(
                "float32", [n, N_OWN], "metres, none, none, none, none, log of metres", own
            ),
            "means": array("float32", [n, 3], "metres", "where points lie, z up"),
            "normals": array("float32", [n, 3], "none", "unit, towards a camera"),
            "descriptors": array(
                "float32", [n, settings["n_descriptors"]], "none", f"at {radii} metres (Eqs 4-6)"
            ),
            "neighbors": array(
                "int64", [n, scales, "neighbors"], "", f"points within {radii} m; -1: none"
            ),
        },
        "outputs": {
            "answers": array(
                "float32",
                [n, knowledge.map.shape[1]],
                "none",
                f"among the embeddings of words by {knowledge.teacher}",
            )
        },
        "normalization": "none outside the graph",
        "settings": settings,
    }


def array(dtype: str, shape: list[str | int], units: str, meaning: str) -> dict[str, Any]:
    """One input or output; a named dimension may have any size from 1."""
    return {"dtype": dtype, "shape": shape, "units": units, "meaning": meaning}
