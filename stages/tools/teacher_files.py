"""The files of a teacher by their addresses, on the web or here: its graph, weights, TOML, labels
and text encoder.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from socket import gaierror
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import quote, unquote, urljoin, urlsplit
from urllib.request import Request, url2pathname, urlopen

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.files import regular
from chebsplat.formats.names import unprintable
from chebsplat.formats.onnx_files import is_graph, weight_files
from chebsplat.formats.teacher_model import FILES, TEXT_PACKAGE, read_settings

ADDRESS = re.compile(r"(?!hf:|\w+://\[)(?:(?:https?|file):[^\s\[\]]+|.+\.(?:onnx|tflite))")
SECONDS = 60.0  # that a server may be silent
AGAIN = "run the same command again"


def full_address(address: str) -> str:
    """A URL as it is, a file with its whole path."""
    path = _here(address)
    return address if path is None else str(path.absolute())


def stem_of(address: str) -> str:
    """The name of its file without the ending. Raises ConfigError on an address without one."""
    file = _file(address)
    if urlsplit(address).path.endswith("/") or file.name in ("", "..") or unprintable(file.name):
        raise ConfigError(f"{address} names no file; give the address of the .onnx itself")
    return file.stem


def gather(address: str, settings: str | None, graph: Path) -> dict[str, Any]:
    """Copy a teacher's encoder to `graph`, and beside it all files that it needs; the values of
    its TOML, which name those.

    Args: address: of the encoder, a URL or a path; settings: of its TOML, None: beside the encoder.
    Raises: InputError naming an address that is not reached, or what lies there.
    Choices: a file is called by the encoder and its key, since a TOML of others may name any path;
      weights are called as their graph says.
    """
    if _file(address).suffix == ".tflite":
        raise InputError(
            f"{address} is TFLite, which nothing here reads; convert it with `python -m "
            "tf2onnx.convert --tflite FILE.tflite --output FILE.onnx`, and give that"
        )
    toml = settings or _beside(address, f"{stem_of(address)}.toml")
    remedy = (
        "write a TOML with at least mean, std and labels (docs/teachers.md), and give it as "
        "--settings FILE.toml"
    )
    copy(toml, graph.with_suffix(".toml"), remedy)
    with called(graph.with_suffix(".toml"), toml):
        values = read_settings(graph.with_suffix(".toml"))
    sources = {graph: address}
    for key in FILES:
        if key in values and not (key == "text" and values[key] == TEXT_PACKAGE):
            source = _beside(toml, values[key])
            values[key] = f"{graph.stem}.{key}{Path(values[key]).suffix}"
            sources[graph.with_name(values[key])] = source
    for place, source in sources.items():
        copy(source, place, f"correct the address, or the name in {toml}")
    for place, source in sources.items():
        if place.suffix != ".onnx":
            continue
        with called(place, source):
            check_graph(place, source)
            names = weight_files(place)
        for name in names:
            copy(
                _beside(source, name),
                place.parent / name,
                f"{source} keeps weights there: correct it",
            )
    return values


def copy(address: str, place: Path, remedy: str) -> None:
    """A file from its address, in folders made for it.

    Raises: InputError, with the remedy where it is not there.
    """
    path = _here(address)
    there = next(each for each in (place, *place.parents) if each.exists())
    if there == place or not there.is_dir():
        raise InputError(f"{address}: {there.name} is the name of two files; rename one")
    place.parent.mkdir(parents=True, exist_ok=True)
    if path is not None:
        regular(path, remedy)
        shutil.copyfile(path, place)
        return
    try:
        request = Request(address, headers={"User-Agent": "chebsplat"})
        with urlopen(request, timeout=SECONDS) as answer, place.open("wb") as file:
            length = answer.headers["Content-Length"]
            expected = None if length is None else int(length)
            shutil.copyfileobj(answer, file)
    except HTTPError as fault:
        fault.close()
        raise InputError(f"{address}: the server answers {fault.code}; {remedy}") from None
    except (URLError, HTTPException, ConnectionError, TimeoutError, ValueError) as fault:
        reason = getattr(fault, "reason", fault)
        if isinstance(reason, gaierror):
            reason = f"no host called {urlsplit(address).hostname} is found"
        raise InputError(
            f"{address} is not reached ({reason}); correct the address, or connect and {AGAIN}"
        ) from None
    if expected is not None and (size := place.stat().st_size) != expected:
        raise InputError(f"{address} broke off at {size:,} of {expected:,} bytes; {AGAIN}")


@contextmanager
def called(place: Path, address: str) -> Iterator[None]:
    """Errors of a copy name the address that it is of, since the copy goes."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace(str(place), address)) from None


def check_graph(path: Path, address: str) -> None:
    """Raises InputError on what is no ONNX graph, as a page about it or a pointer to it."""
    if not is_graph(path):
        with path.open("rb") as file:
            head = file.read(40)
        raise InputError(
            f"{address} is no ONNX graph, it begins with {head!r}; give the address of the .onnx "
            "itself, not of a page about it"
        )


def _here(address: str) -> Path | None:
    """The path that an address means, None of one on the web."""
    parts = urlsplit(address)
    if parts.scheme in ("http", "https"):
        return None
    return Path(url2pathname(parts.path) if parts.scheme == "file" else address).expanduser()


def _file(address: str) -> Path:
    """The path in an address, with the name of its file."""
    return _here(address) or Path(unquote(urlsplit(address).path))


def _beside(address: str, name: str) -> str:
    """The address of a file by its name, relative to that of another."""
    path = _here(address)
    return urljoin(address, quote(name)) if path is None else str(path.parent / name)
