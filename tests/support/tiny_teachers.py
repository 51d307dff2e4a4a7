"""Image encoders of a few numbers, as ONNX files with their TOML and table of labels."""

import json

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

COLORS = {"red": (1.0, -1.0, -1.0), "green": (-1.0, 1.0, -1.0), "blue": (-1.0, -1.0, 1.0)}


def write_model(
    path,
    nodes,
    outputs=("features",),
    shape=(1, 3, "H", "W"),
    kind=TensorProto.FLOAT,
    constants=None,
):
    """An ONNX file of nodes that read `image`; constants by name."""
    entry = helper.make_tensor_value_info("image", kind, shape)
    results = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
    held = [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()]
    graph = helper.make_graph(nodes, "tiny", [entry], results, held)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])
    model.ir_version = 10
    onnx.save(model, path)


def ending(path, *nodes, outputs=None, constants=None):
    """Put nodes that read `features` at the end of a model: (operator, its other inputs,
    attributes).
    """
    model = onnx.load(path)
    name = "features"
    for k, (operator, inputs, attributes) in enumerate(nodes):
        result = f"features{k}"
        model.graph.node.append(helper.make_node(operator, [name, *inputs], [result], **attributes))
        name = result
    held = [
        numpy_helper.from_array(np.asarray(value), of) for of, value in (constants or {}).items()
    ]
    model.graph.initializer.extend(held)
    del model.graph.output[:]
    kept = outputs or [name]
    model.graph.output.extend(
        helper.make_tensor_value_info(of, TensorProto.FLOAT, None) for of in kept
    )
    onnx.save(model, path)
    return path


def moved_out(path, location):
    """Put a model's weights into a file beside it, as exporters do with many."""
    model = onnx.load(path)
    onnx.save(
        model,
        path,
        save_as_external_data=True,
        location=location,
        size_threshold=0,
        convert_attribute=True,
    )


def write_settings(path, **values):
    """The TOML beside a model, and the table of the three colours."""
    held = {"name": "tiny", "labels": "tiny.npz", "mean": [0.5] * 3, "std": [0.5] * 3} | values
    lines = [f"{key} = {json.dumps(value)}" for key, value in held.items() if value is not None]
    path.with_suffix(".toml").write_text("\n".join(lines) + "\n")
    write_table(path.with_name("tiny.npz"))


def write_table(path, names=tuple(COLORS), embeddings=None):
    rows = np.array([COLORS[name] for name in names]) if embeddings is None else embeddings
    np.savez(path, names=np.array(names), embeddings=rows.astype(np.float32))


def color_teacher(folder, stride=4, channels=3, weights=None, shape=(1, 3, "H", "W"), **settings):
    """Mean colour of stride x stride pixels, through a matrix [channels, 3] where one is given; in
    `folder`/tiny.onnx.

    A pixel's feature is its colour in [-1, 1], so that it is nearest to the name of its colour.
    """
    path = folder / "tiny.onnx"
    matrix = np.eye(channels, 3) if weights is None else np.asarray(weights)
    kernel = np.repeat(np.repeat(matrix[:, :, None, None], stride, 2), stride, 3) / stride**2
    node = helper.make_node("Conv", ["image", "kernel"], ["features"], strides=[stride, stride])
    write_model(path, [node], shape=shape, constants={"kernel": kernel.astype(np.float32)})
    write_settings(path, **({"multiple": stride} | settings))
    return path


def knowing_rooms(path):
    """The same teacher, whose table has the classes of generated rooms, too, each beside a
    colour.
    """
    from chebsplat.synthetic import CLASS_NAMES

    names = (*COLORS, *CLASS_NAMES)
    write_table(
        path.with_name("tiny.npz"), names, np.random.default_rng(0).normal(size=(len(names), 3))
    )
    return path


def color_reference(folder, n_images=2, size=(48, 64)):
    """A folder of images of coloured noise in blocks."""
    from PIL import Image

    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(n_images):
        blocks = rng.integers(0, 256, (size[0] // 8, size[1] // 8, 3), dtype=np.uint8)
        Image.fromarray(np.kron(blocks, np.ones((8, 8, 1), np.uint8))).save(folder / f"{k}.png")
    return folder
