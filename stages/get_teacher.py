"""A closed-set segmenter from the Hugging Face hub, or its cache, as the three files of a teacher."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

from chebsplat.errors import ChebsplatError, ConfigError, InputError
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.files import parse_json
from chebsplat.formats.teacher_model import read_teacher

TEACHERS = {"segformer-b0-ade": "Xenova/segformer-b0-finetuned-ade-512-512"}  # ours: the hub's
REPOSITORY = re.compile(r"hf:([\w.-]+/[\w.-]+?)(?:@([\w./-]+))?")
GRAPH, CLASSES, PREPARATION = "onnx/model.onnx", "config.json", "preprocessor_config.json"
WIDER = 4 / 3  # of a photo than of the square that a segmenter is trained on
CHUNK = 2**16  # bytes, after which they are written
AGAIN = "run the same command again: what is there is not fetched again"


def get_teacher(name: str, out: Path | None = None, graph: str = GRAPH) -> tuple[Path, list[tuple[str, str]]]:
    """Fetch a teacher into a folder, as NAME.onnx, NAME.toml and NAME.txt; the .onnx, and what `check-teacher` finds.

    Args: name: of TEACHERS, or hf:OWNER/NAME[@REVISION]; out: the folder, otherwise one called like the teacher, here;
          graph: the ONNX file in the repository.
    Raises: ConfigError on a name or folder that cannot be; InputError naming what is missing, damaged or not reached.
    Choices: a file is taken from the hub's cache where it is there, whole; otherwise a download goes on where an an
      earlier one was stopped. The checksum is the hub's: sha256 of what Git LFS holds, git's own of the small files.
    """
    from chebsplat.stages.teacher_check import check

    repository, revision, short = parsed(name)
    folder = out or Path(short)
    model = folder / f"{short}.onnx"
    origin = f"hf:{repository}@{revision}/{graph}"
    if folder.exists():
        if not model.is_file() or read_teacher(model).origin != origin:
            raise ConfigError(f"{folder} exists and is not {origin}; remove it, or choose another --out")
        return model, check(model)
    part = folder.with_name(f".part-{folder.name}")
    part.mkdir(parents=True, exist_ok=True)
    held = {file: fetched(repository, file, revision, part) for file in (CLASSES, PREPARATION, graph)}
    ready = part / "ready"
    shutil.rmtree(ready, ignore_errors=True)
    ready.mkdir()
    shutil.copyfile(held[graph], ready / model.name)
    classes = class_names(held[CLASSES], repository)
    (ready / f"{short}.txt").write_text("\n".join(classes) + "\n", encoding="utf-8")
    values = {"name": short, "output": "logits", "labels": f"{short}.txt", "origin": origin}
    values |= {"sha256": sha256_file(ready / model.name)} | preparation(held[PREPARATION], repository)
    text = "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())
    (ready / f"{short}.toml").write_text(text, encoding="utf-8")
    ready.rename(folder)
    shutil.rmtree(part)
    try:
        return model, check(model)
    except ChebsplatError:  # what was fetched is no teacher
        shutil.rmtree(folder)
        raise


def parsed(name: str) -> tuple[str, str, str]:
    """(repository, revision, what its files are called)."""
    if name in TEACHERS:
        return TEACHERS[name], "main", name
    if not (found := REPOSITORY.fullmatch(name)):
        known = ", ".join(TEACHERS)
        raise ConfigError(f"{name[:100]!a} is no teacher; there are {known}, and hf:OWNER/NAME[@REVISION]")
    return found[1], found[2] or "main", found[1].rpartition("/")[2].lower()


def fetched(repository: str, file: str, revision: str, part: Path) -> Path:
    """A file of a repository, of the right checksum: in the hub's cache, or in the folder `part`."""
    try:
        import httpx2
        from huggingface_hub import constants, get_hf_file_metadata, hf_hub_url, try_to_load_from_cache
        from huggingface_hub.errors import HfHubHTTPError, OfflineModeIsEnabled
    except ImportError:
        raise ConfigError(
            "get-teacher needs the package huggingface_hub: .venv/bin/pip install -e '.[hub]' installs it"
        ) from None

    try:
        known = get_hf_file_metadata(hf_hub_url(repository, file, revision=revision))
    except (httpx2.TransportError, OfflineModeIsEnabled) as fault:
        cached = try_to_load_from_cache(repository, file, revision=revision)
        if isinstance(cached, str):
            return verified(Path(cached), Path(cached).resolve().name)  # the cache calls a file by its checksum
        offline = isinstance(fault, OfflineModeIsEnabled)
        why = "HF_HUB_OFFLINE is set" if offline else f"{constants.ENDPOINT} is not reached"
        raise InputError(
            f"{repository}: {file} is not in the hub's cache and {why}; connect, or set HF_ENDPOINT to a mirror, and "
            + AGAIN
        ) from None
    except HfHubHTTPError as fault:
        raise InputError(refusal(fault, repository, file, revision)) from None
    if known.etag is None or known.size is None:
        told = f"{constants.ENDPOINT} tells no checksum or size of {repository}'s {file}"
        raise InputError(f"{told}; correct HF_ENDPOINT")
    cached = try_to_load_from_cache(repository, file, revision=known.commit_hash)
    if isinstance(cached, str):
        return verified(Path(cached), known.etag)
    path = part / re.sub(r"\W", "_", known.etag)
    try:
        download(known.location, path, known.size, known.location.startswith(constants.ENDPOINT))
    except HfHubHTTPError as fault:
        raise InputError(refusal(fault, repository, file, revision)) from None
    except httpx2.TransportError:
        done = path.stat().st_size if path.is_file() else 0
        raise InputError(f"{repository}: {file} broke off at {done:,} of {known.size:,} bytes; {AGAIN}") from None
    return verified(path, known.etag, ours=True)


def download(address: str, path: Path, size: int, of_hub: bool) -> None:
    """Bring a file to its size, from where it ends.

    Choices: the hub's client begins again after a stop, and holds 10 MB back before it writes; of a connection that
      breaks here nothing is lost. Who asks is told to the hub alone, not to where it sends its large files.
    """
    from huggingface_hub import get_session
    from huggingface_hub.utils import build_hf_headers, hf_raise_for_status  # type: ignore[attr-defined]

    done = path.stat().st_size if path.is_file() else 0
    if done >= size > 0:
        return
    headers = (build_hf_headers() if of_hub else {}) | {"Accept-Encoding": "identity"}
    headers |= {"Range": f"bytes={done}-"} if done else {}
    with get_session().stream("GET", address, headers=headers, follow_redirects=True) as response:
        hf_raise_for_status(response)
        with path.open("ab" if response.status_code == 206 else "wb") as handle:  # some servers begin anew
            for chunk in response.iter_bytes(CHUNK):
                handle.write(chunk)


def refusal(fault: Any, repository: str, file: str, revision: str) -> str:
    """One line about what the hub answers instead of a file."""
    kind = type(fault).__name__
    if kind == "RemoteEntryNotFoundError":
        return f"hf:{repository} has no {file} at {revision}; name another ONNX file with --file, or another repository"
    if kind in ("RepositoryNotFoundError", "RevisionNotFoundError", "GatedRepoError"):
        return f"hf:{repository}@{revision} is not there, private or gated; correct the name, or log in (hf auth login)"
    return f"hf:{repository}: the hub answers {fault.response.status_code} for {file}; {AGAIN}"


def verified(path: Path, checksum: str, ours: bool = False) -> Path:
    """The file itself, if it has the checksum that the hub gives it; one of our own that has not is removed.

    Raises: InputError naming the file and both checksums.
    """
    if re.fullmatch(r"[0-9a-f]{64}", checksum):
        found = sha256_file(path)
    else:
        data = path.read_bytes()
        found = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
    if found != checksum:
        if ours:
            path.unlink()
        advice = AGAIN if ours else "remove it from the hub's cache, and run again"
        raise InputError(f"{path} has the checksum {found}, {checksum} is right: damaged on the way; {advice}")
    return path


def document(path: Path) -> dict[str, Any]:
    """A JSON object. Raises InputError naming a file that is none."""
    if not isinstance(values := parse_json(path, AGAIN), dict):
        raise InputError(f"{path} is no JSON object; {AGAIN}")
    return values


def class_names(path: Path, repository: str) -> list[str]:
    """Names of the classes in the order of the channels, unique, as a file of labels can hold them."""
    named = document(path).get("id2label")
    if not isinstance(named, dict) or set(named) != {str(k) for k in range(len(named))} or not named:
        raise InputError(f"hf:{repository}: config.json names no classes (id2label); a closed-set segmenter is needed")
    names: list[str] = []
    for k in range(len(named)):
        name = re.sub(r"[:#\s]+", " ", str(named[str(k)])).strip() or f"class {k}"
        names.append(f"{name} ({k})" if name in names else name)
    return names


def preparation(path: Path, repository: str) -> dict[str, Any]:
    """mean, std, size and base of what the model is fed."""
    values = document(path)
    size = values.get("size")
    if isinstance(size, dict):
        size = [size.get("height", size.get("shortest_edge")), size.get("width", size.get("shortest_edge"))]
    sides: list[Any] = list(size) if isinstance(size, list) else [size, size]
    mean, std = values.get("image_mean"), values.get("image_std")
    if len(sides) != 2 or not all(isinstance(side, int) for side in sides) or mean is None or std is None:
        raise InputError(
            f"hf:{repository}: {PREPARATION} has no size, image_mean or image_std as an image encoder needs; export "
            "the model yourself (docs/teachers.md)"
        )
    return {"mean": mean, "std": std, "size": sides, "base": round(max(sides) * WIDER)}
