"""NumPy files are read whole or refused by what they declare, before anything is allocated."""

import io
import os
import zipfile

import numpy as np
import pytest

from chebsplat.errors import InputError
from chebsplat.formats.tensors import read_npy, read_npz


def npy(array, **header):
    """The bytes of a .npy file whose header may lie."""
    held = io.BytesIO()
    kind = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape} | header
    np.lib.format.write_array_header_1_0(held, kind)
    return held.getvalue() + array.tobytes()


@pytest.mark.parametrize("values", [np.zeros((0, 3)), np.array(3), np.arange(4, dtype="f2") > 1])
def test_empty_arrays_and_single_values_come_back(values, tmp_path):
    np.save(tmp_path / "a.npy", values)
    found = read_npy(tmp_path / "a.npy", "copy it again")
    assert (found.shape, found.dtype) == (values.shape, values.dtype) and (found == values).all()


def test_arrays_come_back(tmp_path):
    names, rows = np.array(["wall", "sofa"]), np.asfortranarray(np.arange(6.0).reshape(2, 3))
    np.savez_compressed(tmp_path / "a.npz", names=names, rows=rows, other=np.zeros(3))
    np.save(tmp_path / "a.npy", rows)
    found = read_npz(tmp_path / "a.npz", ("names", "rows", "absent"), "write it again")
    assert set(found) == {"names", "rows"}
    assert found["names"].tolist() == ["wall", "sofa"] and np.array_equal(found["rows"], rows)
    assert np.array_equal(read_npy(tmp_path / "a.npy", "save it again"), rows)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x93NUMPY",
        b"\x93NUMPY\x09\x00" + b"x" * 200,
        npy(np.zeros(3))[:-1],
        npy(np.zeros(3)) + b"x",
        npy(np.zeros(3), shape=(10**12,)),
        npy(np.zeros(3), shape=(-3,)),
        npy(np.zeros(3), descr="|O"),
        npy(np.zeros(3), descr="nonsense"),
        b"\x93NUMPY\x01\x00\x76\x00" + b"(" * 117 + b"\n",
    ],
)
def test_a_header_that_lies_is_refused(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.npy .*; save it again"):
        read_npy(tmp_path / "a.npy", "save it again")
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("rows.npy", content)
    with pytest.raises(InputError, match=r"a\.npz .*; save it again"):
        read_npz(tmp_path / "a.npz", ["rows"], "save it again")


def test_what_unpacks_to_more_than_it_may_is_refused_by_its_size(tmp_path):
    np.savez_compressed(tmp_path / "bomb.npz", rows=np.zeros(10_000), more=np.zeros(10_000))
    with pytest.raises(InputError, match="at most"):
        read_npz(tmp_path / "bomb.npz", ["rows"], "write it again", largest=1000)
    with pytest.raises(InputError, match="at most"):  # in all, not each
        read_npz(tmp_path / "bomb.npz", ["rows", "more"], "write it again", largest=100_000)
    assert (
        read_npz(tmp_path / "bomb.npz", ["rows"], "write it again", largest=100_000)["rows"].size
        == 10_000
    )


def test_what_is_no_regular_file_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes(b"no zip")
    for name in ("a.npz", "b.npz", "c.npz"):
        with pytest.raises(InputError, match=name):
            read_npz(tmp_path / name, ["rows"], "write it again")
    with pytest.raises(InputError, match="a pipe"):
        read_npy(tmp_path / "a.npz", "write it again")
