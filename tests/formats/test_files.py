"""Files from outside are read whole and bounded, or refused at once in words."""

import os

import pytest

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.files import (
    atomic_path,
    atomic_write,
    parse_json,
    parse_toml,
    read_text,
    regular,
)


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    "kind", ["pipe", "device", "folder", "dangling", "looping", "absent", "too long", "null"]
)
def test_what_is_no_file_is_refused_at_once(tmp_path, kind):
    path = tmp_path / {"too long": "x" * 300, "null": "a\0b"}.get(kind, "a.json")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind in ("device", "dangling", "looping"):
        path.symlink_to(
            {"device": "/dev/zero", "dangling": tmp_path / "none", "looping": path}[kind]
        )
    for read in (regular, read_text, parse_json, parse_toml):
        with pytest.raises(InputError, match="; restore the file"):
            read(path)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"a":' * 100_000,
        "1" * 5000,
        '"\\ud800"',
        '"\\udc80"',
        b"\xff",
        "{",
        "",
        '{"a": 1, "a": 2}',
    ],
)
def test_json_that_cannot_be_used_is_named(tmp_path, text):
    with pytest.raises(InputError, match=r"a\.json .*; restore the file"):
        parse_json(write(tmp_path / "a.json", text))


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 100_000,
        "a = " + "{a=" * 100_000,
        "a." * 400_000 + "a = 1",
        "[a",
        b"a = '\xff'",
        "a = 1\n" * 2,
    ],
)
def test_toml_that_cannot_be_used_is_named(tmp_path, text):
    with pytest.raises(ConfigError, match=r"a\.toml .*; correct it"):
        parse_toml(write(tmp_path / "a.toml", text), "correct it", ConfigError)


def test_a_file_of_gigabytes_is_refused_unread(tmp_path):
    path = write(tmp_path / "a.json", "{}")
    os.truncate(path, 1 << 40)
    with pytest.raises(InputError, match="bytes, more than"):
        parse_json(path)


def test_names_in_any_language_and_a_byte_order_mark_are_read(tmp_path):
    assert parse_json(write(tmp_path / "a.json", "\ufeff" + '{"é": "\\ud83d\\ude00"}')) == {
        "é": "😀"
    }
    assert parse_toml(write(tmp_path / "a.toml", "\ufeffa.b.c = '沙'")) == {"a": {"b": {"c": "沙"}}}


def test_a_file_is_written_whole_or_stays_as_it_was(tmp_path):
    file = tmp_path / "new" / "notes.json"
    atomic_write(file, "é\n")
    assert file.read_bytes() == "é\n".encode()
    with pytest.raises(RuntimeError), atomic_path(file) as temporary:
        assert temporary.suffix == file.suffix
        temporary.write_bytes(b"half")
        raise RuntimeError
    assert file.read_bytes() == "é\n".encode()
    atomic_write(file, b"\xff")
    assert file.read_bytes() == b"\xff"
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_a_file_written_whole_is_as_readable_as_the_umask_says(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        atomic_write(tmp_path / "x", "1")
    finally:
        os.umask(before)
    assert (tmp_path / "x").stat().st_mode & 0o777 == mode
