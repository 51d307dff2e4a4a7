"""Weights beside a graph are found wherever in it they are named, and are part of what a model
is.
"""

import pytest
from onnx import AttributeProto, GraphProto, ModelProto, NodeProto, SparseTensorProto, TensorProto
from onnx.external_data_helper import set_external_data

from chebsplat.errors import InputError
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.onnx_files import model_files, model_sha256


def outside(location):
    tensor = TensorProto(name="k", data_type=TensorProto.FLOAT, dims=[1], raw_data=b"1234")
    set_external_data(tensor, location)
    tensor.ClearField("raw_data")
    return tensor


def constant(location):
    return NodeProto(
        op_type="Constant", attribute=[AttributeProto(name="value", t=outside(location))]
    )


def branch(location):
    inner = GraphProto(initializer=[outside(location)])
    return NodeProto(op_type="If", attribute=[AttributeProto(name="then_branch", g=inner)])


PLACES = {
    "initializer": lambda at: ModelProto(graph=GraphProto(initializer=[outside(at)])),
    "sparse": lambda at: ModelProto(
        graph=GraphProto(sparse_initializer=[SparseTensorProto(values=outside(at))])
    ),
    "constant": lambda at: ModelProto(graph=GraphProto(node=[constant(at)])),
    "branch": lambda at: ModelProto(graph=GraphProto(node=[branch(at)])),
    "function": lambda at: ModelProto(functions=[{"node": [constant(at)]}]),
    "branch of a function": lambda at: ModelProto(functions=[{"node": [branch(at)]}]),
}


@pytest.mark.parametrize("place", PLACES)
def test_weights_are_found_and_count_wherever_a_graph_names_them(tmp_path, place):
    path, weights = tmp_path / "model.onnx", tmp_path / "parts/weights.bin"
    path.write_bytes(PLACES[place]("parts/weights.bin").SerializeToString())
    weights.parent.mkdir()
    with pytest.raises(
        InputError,
        match=r"parts/weights.bin is missing; .*model.onnx keeps "
        r"weights there",
    ):
        model_files(path)
    weights.write_bytes(b"1234")
    assert model_files(path) == [path, weights]
    before = model_sha256(path)
    weights.write_bytes(b"1235")
    assert model_sha256(path) != before
    for beyond in ("../weights.bin", str(weights)):
        path.write_bytes(PLACES[place](beyond).SerializeToString())
        with pytest.raises(InputError, match="has weights outside its folder"):
            model_files(path)


def test_a_model_in_one_file_has_the_sha256_of_that_file(tmp_path):
    (tmp_path / "model.onnx").write_bytes(b"no graph")
    assert model_sha256(tmp_path / "model.onnx") == sha256_file(tmp_path / "model.onnx")
