"""The encoder (Eq 7) and the fusion behind it (Eqs 8-10) as ONNX graphs, operation by operation as torch computes them.

Written by hand: torch's own exporter traces these two small modules for 20 s and more. What is written here is compared
with the modules at every export (`stages/onnx.py`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, checker, helper, numpy_helper
from torch import nn

from chebsplat.shape.encoder import N_FREQUENCIES, Attention, Block, RegionEncoder
from chebsplat.shape.fusion import LEAST, Fusion

OPSET = 18  # of the ONNX files
Value = Any  # the name of what a node makes, a torch tensor, or a NumPy constant


class Graph:
    """Nodes in the order of their making. Dimensions of inputs and outputs are numbers, or names of any size from 1."""

    def __init__(self, **inputs: tuple[int, list[int | str]]):
        """inputs: by name, element type and shape."""
        self.inputs = [helper.make_tensor_value_info(name, *entry) for name, entry in inputs.items()]
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []

    def add(self, operator: str, *inputs: Value, **attributes: Any) -> str:
        """One node with one output; gives its name."""
        return self.split(operator, 1, *inputs, **attributes)[0]

    def split(self, operator: str, count: int, *inputs: Value, **attributes: Any) -> list[str]:
        """One node with `count` outputs."""
        made = [f"{operator.lower()}_{len(self.nodes)}" + (f"_{k}" if k else "") for k in range(count)]
        self.nodes.append(helper.make_node(operator, [self._name(v) for v in inputs], made, **attributes))
        return made

    def _name(self, value: Value) -> str:
        if isinstance(value, str):
            return value
        array = value if isinstance(value, np.ndarray) else value.detach().numpy()
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name))
        return name

    def linear(self, values: Value, layer: Any) -> str:
        """values Wᵀ + b of an `nn.Linear`."""
        return self.add("Add", self.add("MatMul", values, layer.weight.T), layer.bias)

    def layer_norm(self, values: Value, layer: nn.LayerNorm) -> str:
        return self.add("LayerNormalization", values, layer.weight, layer.bias, axis=-1, epsilon=layer.eps)

    def gelu(self, values: Value) -> str:
        upper = self.add("Add", self.add("Erf", self.add("Mul", values, number(math.sqrt(0.5)))), number(1))
        return self.add("Mul", self.add("Mul", values, number(0.5)), upper)

    def first(self, values: Value, count: int) -> str:
        """values[:, :count]."""
        return self.add("Slice", values, whole(0), whole(count), whole(1))

    def model(self, name: str, **outputs: tuple[str, list[int | str]]) -> ModelProto:
        """outputs: by name, the float32 value that it is, and its shape. Raises onnx.checker.ValidationError."""
        for output, (value, _) in outputs.items():
            self.nodes.append(helper.make_node("Identity", [value], [output]))
        made = [helper.make_tensor_value_info(o, TensorProto.FLOAT, shape) for o, (_, shape) in outputs.items()]
        graph: GraphProto = helper.make_graph(self.nodes, name, self.inputs, made, self.constants)
        opsets = [helper.make_opsetid("", OPSET)]
        version = helper.find_min_ir_version_for(opsets)
        model = helper.make_model(graph, opset_imports=opsets, ir_version=version, producer_name="chebsplat")
        checker.check_model(model)
        return model


def number(value: float) -> np.ndarray:
    """A float32 constant []."""
    return np.array(value, np.float32)


def whole(*values: int) -> np.ndarray:
    """An int64 constant [n]."""
    return np.array(values, np.int64)


def encoder_model(encoder: RegionEncoder) -> ModelProto:
    """`RegionEncoder.forward`: inputs [regions, members, n_inputs], positions, mask -> encodings [regions, C]."""
    region: list[int | str] = ["regions", "members"]
    graph = Graph(
        inputs=(TensorProto.FLOAT, [*region, encoder.n_inputs]),
        positions=(TensorProto.FLOAT, [*region, encoder.n_positions]),
        mask=(TensorProto.BOOL, region),
    )
    octaves = np.array([[math.pi * 2.0**k] for k in range(N_FREQUENCIES)], np.float32)
    angles = graph.add("Mul", graph.add("Unsqueeze", "positions", whole(2)), octaves)
    angles = graph.add("Reshape", angles, whole(0, 0, encoder.n_positions * N_FREQUENCIES))
    waves = graph.add("Concat", "positions", graph.add("Sin", angles), graph.add("Cos", angles), axis=-1)
    tokens = graph.linear(waves, encoder.embed_position)
    if encoder.n_inputs:
        norm = encoder.norm_input
        inputs = graph.add("Div", graph.add("Sub", "inputs", norm.mean), norm.deviation)
        inputs = graph.add("Clip", inputs, number(-5), number(5))
        tokens = graph.add("Add", tokens, graph.linear(inputs, encoder.embed_input))
    tokens = graph.linear(graph.gelu(tokens), encoder.hidden)
    pooled = _attended(graph, encoder, tokens) if len(encoder.blocks) else _pooled(graph, tokens)
    first, _, second = encoder.decode
    pooled = graph.linear(graph.gelu(graph.linear(graph.layer_norm(pooled, encoder.norm), first)), second)
    return graph.model("encoder", encodings=(pooled, ["regions", encoder.n_channels]))


def _attended(graph: Graph, encoder: RegionEncoder, tokens: str) -> str:
    """The region token [regions, width] behind all blocks."""
    count = graph.add("Shape", "mask", start=0, end=1)
    region = graph.add("Expand", encoder.region_token[None, None], graph.add("Concat", count, whole(1, 1), axis=0))
    tokens = graph.add("Concat", region, tokens, axis=1)
    present = graph.add("Expand", np.ones((1, 1), bool), graph.add("Concat", count, whole(1), axis=0))
    mask = graph.add("Unsqueeze", graph.add("Concat", present, "mask", axis=1), whole(1, 2))
    for depth, block in enumerate(encoder.blocks, 1):
        tokens = _block(graph, block, tokens, mask, only_region=depth == len(encoder.blocks))  # type: ignore[arg-type]
    return graph.add("Squeeze", tokens, whole(1))


def _block(graph: Graph, block: Block, tokens: str, mask: str, only_region: bool) -> str:
    seen = graph.layer_norm(tokens, block.norm_attention)
    asking = graph.first(seen, 1) if only_region else seen
    residual = graph.first(tokens, 1) if only_region else tokens
    tokens = graph.add("Add", residual, _attention(graph, block.attention, asking, seen, mask))
    inner = graph.gelu(graph.linear(graph.layer_norm(tokens, block.norm_forward), block.forward_1))
    return graph.add("Add", tokens, graph.linear(inner, block.forward_2))


def _attention(graph: Graph, attention: Attention, asking: str, tokens: str, mask: str) -> str:
    def heads(values: str, layer: nn.Linear, order: tuple[int, ...]) -> str:
        parted = graph.add("Reshape", graph.linear(values, layer), whole(0, 0, attention.n_heads, -1))
        return graph.add("Transpose", parted, perm=order)

    width = attention.query.out_features // attention.n_heads
    query, value = heads(asking, attention.query, (0, 2, 1, 3)), heads(tokens, attention.value, (0, 2, 1, 3))
    scores = graph.add("MatMul", query, heads(tokens, attention.key, (0, 2, 3, 1)))
    scores = graph.add("Where", mask, graph.add("Div", scores, number(math.sqrt(width))), number(-1e9))
    mixed = graph.add("MatMul", graph.add("Softmax", scores, axis=-1), value)
    mixed = graph.add("Reshape", graph.add("Transpose", mixed, perm=(0, 2, 1, 3)), whole(0, 0, -1))
    return graph.linear(mixed, attention.output)


def _pooled(graph: Graph, tokens: str) -> str:
    """The maximum over a region's tokens [regions, width], 0 where it has none."""
    kept = graph.add("Where", graph.add("Unsqueeze", "mask", whole(2)), tokens, number(-1e9))
    highest = graph.add("ReduceMax", kept, whole(1), keepdims=0)
    members = graph.add("ReduceMax", graph.add("Cast", "mask", to=TensorProto.INT32), whole(1), keepdims=1)
    return graph.add("Where", graph.add("Cast", members, to=TensorProto.BOOL), highest, number(0))


def fusion_model(fusion: Fusion) -> ModelProto:
    """`Fusion.forward`: features, encodings and where regions lie -> fused, gate [gaussians, C]."""
    linear, kind = fusion.gate.linear, TensorProto.FLOAT
    n_channels = linear.out_features
    graph = Graph(
        features=(kind, ["gaussians", n_channels]),
        encodings=(kind, ["regions", n_channels]),
        cover=(TensorProto.INT64, ["gaussians", "covers"]),
        means=(kind, ["gaussians", 3]),
        centers=(kind, ["regions", 3]),
        quats=(kind, ["regions", 4]),
        scales=(kind, ["regions", 3]),
        radius=(kind, []),
    )
    index = graph.add("Max", "cover", whole(0))
    weights = graph.add("Unsqueeze", _propagation_weights(graph, index, fusion), whole(2))
    carried = graph.add("Mul", graph.add("Gather", "encodings", index), weights)
    shape = graph.add("ReduceSum", carried, whole(1), keepdims=0)
    nearest = graph.add("Slice", "cover", whole(0), whole(1), whole(1))
    logits = graph.linear(graph.add("Concat", shape, "features", axis=-1), linear)
    covered = graph.add("GreaterOrEqual", nearest, whole(0))
    share = graph.add("Where", covered, graph.add("Sigmoid", logits), number(1))
    rest = graph.add("Mul", graph.add("Sub", number(1), share), shape)
    fused = graph.add("Add", graph.add("Mul", share, "features"), rest)
    size: list[int | str] = ["gaussians", n_channels]
    return graph.model("fusion", fused=(fused, size), gate=(share, size))


def _propagation_weights(graph: Graph, index: str, fusion: Fusion) -> str:
    """`fusion.propagation_weights` [gaussians, covers] (Eq 8)."""
    away = graph.add("Sub", graph.add("Unsqueeze", "means", whole(1)), graph.add("Gather", "centers", index))
    away = graph.add("Unsqueeze", graph.add("Div", away, "radius"), whole(3))
    turned = graph.add("Mul", graph.add("Gather", _rotations(graph), index), away)
    local = graph.add("ReduceSum", turned, whole(2), keepdims=0)
    spread = graph.add("Div", graph.add("Gather", "scales", index), "radius")
    variances = graph.add("Add", graph.add("Mul", spread, spread), number(fusion.inflation**2))
    variances = graph.add("Max", variances, number(LEAST))
    distances = graph.add("Div", graph.add("Mul", local, local), variances)
    logits = graph.add("Neg", graph.add("ReduceSum", distances, whole(2), keepdims=0))
    logits = graph.add("Div", logits, number(fusion.temperature))
    present = graph.add("GreaterOrEqual", "cover", whole(0))
    count = graph.add("ReduceMax", graph.add("Cast", present, to=TensorProto.INT32), whole(1), keepdims=1)
    covered = graph.add("Cast", count, to=TensorProto.BOOL)
    absent = graph.add("And", graph.add("Not", present), covered)
    weights = graph.add("Softmax", graph.add("Where", absent, number(-math.inf), logits), axis=-1)
    return graph.add("Where", present, weights, number(0))


def _rotations(graph: Graph) -> str:
    """`rotation_matrices` [regions, 3, 3] of quats [regions, 4]."""
    largest = graph.add("ReduceMax", graph.add("Abs", "quats"), whole(-1), keepdims=1)
    scaled = graph.add("Div", "quats", graph.add("Max", largest, number(1e-30)))
    length = graph.add("Max", graph.add("ReduceL2", scaled, whole(-1), keepdims=1), number(1e-12))
    w, x, y, z = graph.split("Split", 4, graph.add("Div", scaled, length), axis=-1, num_outputs=4)

    def twice(operator: str, a: str, b: str, c: str, d: str) -> str:
        """2 (a b ± c d)."""
        both = graph.add(operator, graph.add("Mul", a, b), graph.add("Mul", c, d))
        return graph.add("Mul", both, number(2))

    def one_less(value: str) -> str:
        return graph.add("Sub", number(1), value)

    rows = [
        [one_less(twice("Add", y, y, z, z)), twice("Sub", x, y, w, z), twice("Add", x, z, w, y)],
        [twice("Add", x, y, w, z), one_less(twice("Add", x, x, z, z)), twice("Sub", y, z, w, x)],
        [twice("Sub", x, z, w, y), twice("Add", y, z, w, x), one_less(twice("Add", x, x, y, y))],
    ]
    entries = [entry for row in rows for entry in row]
    return graph.add("Reshape", graph.add("Concat", *entries, axis=-1), whole(0, 3, 3))
