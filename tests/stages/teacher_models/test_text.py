"""Words become vectors of a teacher's text space: by its table, then by its encoder, and never by a
guess.
"""

import logging
import sys

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from shared import ROOT

from chebsplat.errors import InputError
from chebsplat.formats.teacher_model import (
    EMBEDDED,
    TeacherModel,
    read_label_set,
    read_label_table,
    read_teacher,
)
from chebsplat.labels.decode import VOCABULARY
from chebsplat.labels.names import folded
from chebsplat.stages.teacher_models import text_encoder
from chebsplat.stages.teacher_models.label_space import IN_ROOMS, label_set
from chebsplat.stages.teacher_models.text_encoder import text_embeddings
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.teachers.words import NOUNS, TABLE

NAMES = ["chair", "tv-screen", "battery", "Box", "glass"]


@pytest.fixture
def teacher(tmp_path):
    np.savez(
        tmp_path / "table.npz", names=np.array(NAMES), embeddings=2 * np.eye(5, 6, dtype=np.float32)
    )
    return TeacherModel(tmp_path / "model.onnx", "toy", labels=tmp_path / "table.npz")


@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("chair", 0),
        ("Chair", 0),
        ("tv screen", 1),
        ("TV_Screen", 1),
        ("tv-screen", 1),
        ("Tvscreen", 1),
        (" box ", 3),
        ("glass", 4),
    ],
)
def test_a_name_is_found_whatever_its_case_hyphens_and_underscores(teacher, name, row):
    assert np.array_equal(text_embeddings([name], teacher), np.eye(5, 6, dtype=np.float32)[[row]])


@pytest.mark.parametrize(
    ("name", "row"), [("chairs", 0), ("batteries", 2), ("boxes", 3), ("glasses", 4)]
)
def test_a_plural_takes_its_singular_and_says_so(teacher, name, row, caplog):
    with caplog.at_level(logging.INFO, "chebsplat"):
        found = text_embeddings([name], teacher)
    assert found.argmax() == row
    assert f"{name} is not in" in caplog.text
    assert NAMES[row] in caplog.text


@pytest.mark.parametrize(
    ("name", "form"),
    [("AirConditioner", "air conditioner"), ("chair_02", "chair"), ("tvStand3", "tv stand"),
     ("TVStands", "tv stand"),
     ("office chair", "chair"), ("OfficeChairs", "chair"), ("stand by_3", "by"), ("9-11", None),
     ("", None)],
)  # fmt: skip
def test_a_label_is_found_by_the_words_it_is_made_of_and_then_by_the_last(name, form):
    known = ["stand", "tv stand", "air conditioner", "conditioner", "by", "chair"]
    assert text_encoder.match_names([name], known) == [known.index(form) if form else -1]
    assert text_encoder.match_names([name], [*known, name])[0] == (
        known.index(name) if name in known else len(known)
    )


def test_the_last_word_stands_for_a_phrase_only_where_no_encoder_knows_better(teacher, caplog):
    with caplog.at_level(logging.INFO, "chebsplat"):
        assert text_embeddings(["office chair", "Chair_7"], teacher).argmax(1).tolist() == [0, 0]
    assert "office chair is not in" in caplog.text and "Chair_7 is not in" in caplog.text
    assert text_encoder.match_names(["office chair", "Chair_7"], NAMES, last_word=False) == [-1, 0]


def test_rows_come_in_the_order_asked_for(teacher):
    found = text_embeddings(["glass", "chair", "glass"], teacher)
    assert found.argmax(1).tolist() == [4, 0, 4]
    assert found.dtype == np.float32


def test_an_unknown_word_is_named_with_the_nearest_and_the_remedy(teacher):
    with pytest.raises(
        InputError,
        match=r"table\.npz does not know 'chairz' \(near: chair\).*add "
        r"them",
    ) as caught:
        text_embeddings(["chairz", "box"], teacher)
    assert "'box'" not in str(caught.value)


def with_text(teacher, **changes):
    return TeacherModel(teacher.path, "toy", labels=teacher.labels, **changes)


def test_without_the_extra_known_names_are_found_and_others_say_what_to_install(
    teacher, monkeypatch
):
    monkeypatch.setitem(sys.modules, text_encoder.PACKAGE, None)
    with pytest.raises(
        InputError, match=r"'something to sit on'.* needs the extra `text`: .*\[text\]"
    ):
        text_embeddings(["something to sit on"], with_text(teacher, text="minilm"))
    assert text_embeddings(["chair"], with_text(teacher, text="minilm")).argmax() == 0


# a text encoder of the user's


@pytest.fixture
def encoder(teacher, tmp_path):
    """Mean of one vector a word, and the tokenizer of five words."""
    tokenizers = pytest.importorskip("tokenizers", reason="comes with the extra `text`")
    words = {"[UNK]": 0, "a": 1, "photo": 2, "of": 3, "lamp": 4}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordLevel(words, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    tokenizer.save(str(tmp_path / "tokenizer.json"))
    write_encoder(tmp_path / "text.onnx")
    return with_text(
        teacher,
        text=tmp_path / "text.onnx",
        tokenizer=tmp_path / "tokenizer.json",
        prompt="a photo of a {}",
    )


def write_encoder(path, names=("input_ids", "attention_mask"), keepdims=0):
    vectors = numpy_helper.from_array(np.eye(5, 6, dtype=np.float32), "vectors")
    axes = numpy_helper.from_array(np.array([1]), "axes")
    nodes = [
        helper.make_node("Gather", ["vectors", names[0]], ["rows"]),
        helper.make_node("ReduceMean", ["rows", "axes"], ["mean"], keepdims=keepdims),
    ]
    entries = [helper.make_tensor_value_info(name, TensorProto.INT64, [1, "n"]) for name in names]
    result = helper.make_tensor_value_info("mean", TensorProto.FLOAT, None)
    model = helper.make_model(
        helper.make_graph(nodes, "toy", entries, [result], [vectors, axes]),
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=10,
    )
    onnx.save(model, path)


@pytest.mark.parametrize("names", [("input_ids", "attention_mask"), ("tokens",)])
def test_what_the_table_lacks_goes_through_prompt_tokenizer_and_encoder(encoder, names):
    write_encoder(encoder.text, names)
    found = text_embeddings(["lamp", "chair"], encoder)
    wanted = np.array([0, 2, 1, 1, 1, 0]) / np.sqrt(7)  # a photo of a lamp
    assert np.allclose(found[0], wanted, atol=1e-6)
    assert found[1].argmax() == 0  # of the table, without prompt


@pytest.mark.parametrize(
    ("damage", "said"),
    [(lambda e: e.tokenizer.write_text("{}"), "tokenizer.json"),
     (lambda e: e.text.write_text("text"), "cannot be run"),
     (lambda e: write_encoder(e.text, ("words", "mask")), "inputs are input_ids"),
     (lambda e: write_encoder(e.text, keepdims=1), r"\[1, C\] is needed")],
)  # fmt: skip
def test_an_encoder_that_cannot_be_used_is_named(encoder, damage, said):
    damage(encoder)
    with pytest.raises(InputError, match=said):
        text_embeddings(["lamp"], encoder)


# what ships


def test_the_table_holds_the_nouns_as_unit_rows():
    names, embeddings = read_label_table(TABLE)
    assert names == list(read_label_set(NOUNS))
    assert len({folded(name) for name in names}) == len(names) > 3000
    assert np.allclose(np.linalg.norm(embeddings, axis=1), 1, atol=2e-3)
    assert TABLE.stat().st_size < 2.5e6


def test_the_table_is_the_sentence_models_output_to_float16():
    pytest.importorskip(text_encoder.PACKAGE, reason="the extra `text`")
    names, embeddings = read_label_table(TABLE)
    found = text_encoder.sentence_embeddings(names[::40])
    # a row may round to either neighbour, since its last float32 bits depend on the batch
    assert np.abs(found - embeddings[::40]).max() <= 2.0**-12


def test_every_label_that_we_ship_is_in_the_table():
    known = {folded(name) for name in read_label_table(TABLE)[0]}
    shipped = [
        name for path in (ROOT / "teachers/labels").glob("*.txt") for name in read_label_set(path)
    ]
    assert len(shipped) == 171
    assert not [name for name in (*CLASS_NAMES, *VOCABULARY, *shipped) if folded(name) not in known]


def test_label_sets_keep_the_order_that_their_protocols_count_by():
    ade, scannet = (
        list(read_label_set(ROOT / f"teachers/labels/{name}.txt"))
        for name in ("ade20k", "scannet20")
    )
    assert {k: ade[k - 1] for k in (1, 4, 15, 29, 40, 58, 90, 150)} == {
        1: "wall", 4: "floor", 15: "door", 29: "rug", 40: "cushion", 58: "pillow", 90: "television",
        150: "flag"
    }  # fmt: skip
    assert (scannet[0], scannet[10], scannet[11], len(scannet)) == (
        "other",
        "shelves",
        "counter",
        21,
    )


def test_what_rooms_hold_is_asked_for_where_nobody_names_classes(teacher):
    asked = label_set(read_teacher(EMBEDDED), None, None)
    assert list(asked) == list(IN_ROOMS)  # of 3104 nouns
    assert 24 <= len(asked) <= 60
    assert list(label_set(teacher, None, None)) == NAMES  # a teacher that knows few of them
    assert list(label_set(read_teacher(EMBEDDED), None, ["zebra"])) == ["zebra"]
