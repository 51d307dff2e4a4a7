"""A teacher in a folder of its own, from the Hugging Face hub, or its cache, or by the address of
an ONNX file; and a trial of a teacher on an image before a scene: its settings, cost and labels.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.extras import require
from chebsplat.formats.files import parse_json
from chebsplat.formats.images import images_below, read_rgb
from chebsplat.formats.onnx_files import model_sha256, weight_files
from chebsplat.formats.teacher_model import RESAMPLING, read_label_table, read_teacher
from chebsplat.kernels.threads import n_threads
from chebsplat.labels.scores import LOGITS, UNSURE, sureness
from chebsplat.labels.tiling import window_starts
from chebsplat.stages.settings import MAX_CHANNELS, TeacherSection
from chebsplat.stages.teacher_models.label_space import closed_set, label_set, open_vocabulary
from chebsplat.stages.tools.teacher_files import (
    ADDRESS,
    AGAIN,
    copy,
    full_address,
    gather,
    stem_of,
)
from chebsplat.synthetic.layout import REFERENCE

TEACHERS = {
    "segformer-b0-ade": "Xenova/segformer-b0-finetuned-ade-512-512"
}  # repository on the hub by our name
REPOSITORY = re.compile(r"hf:([\w.-]+/[\w.-]+?)(?:@([\w./-]+))?")
GRAPH, CLASSES, PREPARATION = "onnx/model.onnx", "config.json", "preprocessor_config.json"
WIDER = 4 / 3  # aspect ratio of a photo, for the square that a segmenter is trained on
STEPS = (  # of an image processor: those that keys of a TOML replace, and those without effect
    "resize", "center_crop", "rescale", "normalize", "flip_channel_order", "convert_rgb",
    "reduce_labels", "pad",
)  # fmt: skip
N_LABELS, N_PHOTOS = 8, 8  # of a trial


@contextmanager
def _short_names() -> Iterator[None]:
    """Raises ConfigError where a file's name is longer than the disk takes."""
    try:
        yield
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        raise ConfigError(
            f"{Path(error.filename).name[:60]}... cannot be written ({error.strerror}); give it a "
            "shorter name, or choose another --out"
        ) from None


@_short_names()
def get_teacher(
    name: str,
    out: Path | None = None,
    graph: str = GRAPH,
    settings: str | None = None,
    sha256: str | None = None,
) -> tuple[Path, list[tuple[str, str]]]:
    """Fetch a teacher into a folder as NAME.onnx, .toml and its labels; the .onnx, and `check` of
    it.

    Args: name: of TEACHERS, hf:OWNER/NAME[@REVISION], or the address of an ONNX file; out: the
      folder, otherwise one called like the teacher, here; graph: the ONNX file in the repository;
      settings: the address of the TOML of one that is not from the hub, None: beside it; sha256:
      that the model must have (`model_sha256`), None: that of its TOML, if it says one.
    Raises: ConfigError on a name or folder that cannot be; InputError naming what is missing,
      damaged or not reached.
    """
    if ADDRESS.fullmatch(name):
        if graph != GRAPH:
            raise ConfigError(
                f"--file is of the hub's repositories, and {name} is a file; leave it"
            )
        origin, short = full_address(name), stem_of(name)
        fill = partial(gather, name, settings)
    else:
        repository, revision, short = parsed(name)
        if settings is not None:
            raise ConfigError(f"--settings is of an address, and {name} brings its own; leave it")
        origin = f"hf:{repository}@{revision}/{graph}"
        fill = partial(from_hub, repository, revision, graph)
    folder = out or Path(short)
    model = folder / f"{short}.onnx"
    if folder.exists():
        other = not model.is_file() or read_teacher(model).origin != origin
        if other or settings is not None:
            why = f"is not {origin}" if other else f"keeps its TOML, whatever {settings} says"
            raise ConfigError(f"{folder} exists and {why}; remove it, or choose another --out")
        compare(sha256, model, origin)
        return model, check(model)
    part = folder.with_name(f".part-{folder.name}")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        graph_copy = part / model.name
        values = {"name": short} | fill(graph_copy)
        compare(expected := sha256 or values.get("sha256"), graph_copy, origin)
        values |= {"origin": origin, "sha256": model_sha256(graph_copy)}
        lines = (f"{k} = {json.dumps(value, ensure_ascii=False)}\n" for k, value in values.items())
        graph_copy.with_suffix(".toml").write_text("".join(lines), encoding="utf-8")
        part.rename(folder)
    except BaseException:  # it is no teacher, or the user waits no longer
        shutil.rmtree(part, ignore_errors=True)
        raise
    try:
        findings = check(model)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    if expected is None and not origin.startswith("hf:"):
        digest = values["sha256"]
        remark = "compare it with its publisher's; to get no other, add --sha256"
        findings.append(("sha256", f"{digest}; {remark} {digest}"))
    return model, findings


def compare(sha256: str | None, model: Path, origin: str) -> None:
    """Raises InputError where a model has not the checksum that was asked for, if one was."""
    if sha256 is not None and (digest := model_sha256(model)) != sha256.lower():
        raise InputError(
            f"{origin} has the sha256 {digest}, {sha256} was asked for: it is another file, or was "
            "damaged on the way; compare with its publisher's"
        )


def from_hub(repository: str, revision: str, graph: str, model: Path) -> dict[str, Any]:
    """Copy a repository's graph to `model`, its weights and its classes beside; values of a TOML.

    Raises: InputError naming what is missing, damaged or not reached.
    """
    files = {file: fetch_file(repository, file, revision) for file in (CLASSES, PREPARATION, graph)}
    weights = {
        name: fetch_file(repository, f"{PurePosixPath(graph).parent / name}", revision)
        for name in weight_files(files[graph])
    }
    shutil.copyfile(files[graph], model)
    labels = model.with_suffix(".txt")
    classes = class_names(files[CLASSES], repository)
    labels.write_text("\n".join(classes) + "\n", encoding="utf-8")
    for name, file in weights.items():
        copy(str(file), model.parent / name, AGAIN)
    return {"output": "logits", "labels": labels.name} | preparation(files[PREPARATION], repository)


def parsed(name: str) -> tuple[str, str, str]:
    """(repository, revision, stem of the teacher's files)."""
    if name in TEACHERS:
        return TEACHERS[name], "main", name
    if not (match := REPOSITORY.fullmatch(name)):
        names = ", ".join(TEACHERS)
        raise ConfigError(
            f"{name[:100]!a} is no teacher; there are {names}, hf:OWNER/NAME[@REVISION], and ONNX "
            "files by https: or path"
        )
    return match[1], match[2] or "main", match[1].rpartition("/")[2].lower()


def fetch_file(repository: str, file: str, revision: str) -> Path:
    """A file of a repository in the hub's cache, downloaded if need be, its checksum verified."""
    require("huggingface_hub", "get-teacher")
    import httpx2
    from huggingface_hub import constants, errors, hf_hub_download

    where = f"{repository}: {file}"
    try:
        token = token_for(constants.ENDPOINT)
        return verify_checksum(
            Path(hf_hub_download(repository, file, revision=revision, token=token))
        )
    except errors.LocalEntryNotFoundError as fault:
        why = f"{constants.ENDPOINT} is not reached"
        if isinstance(fault.__cause__, errors.OfflineModeIsEnabled):
            why = "HF_HUB_OFFLINE is set"
        elif isinstance(fault.__cause__, errors.FileMetadataError):
            why = f"{constants.ENDPOINT} answers as no hub does"
        remedy = f"connect, or set HF_ENDPOINT to a mirror, and {AGAIN}"
        raise InputError(f"{where} is not in the hub's cache and {why}; {remedy}") from None
    except errors.HfHubHTTPError as fault:
        raise InputError(refusal(fault, repository, file, revision)) from None
    except (httpx2.TransportError, OSError, RuntimeError) as fault:
        if isinstance(fault, OSError) and fault.errno is not None:  # an error of the disk
            raise
        message = str(fault).partition("\n")[0]
        raise InputError(f"{where} broke off ({message}); {AGAIN}") from None


def token_for(endpoint: str) -> Literal[False] | None:
    """The token argument for the hub's client: its own (None), or no token (False).

    Choices: the token of a login goes to huggingface.co alone; one that HF_TOKEN names goes to
      HF_ENDPOINT. The client sends none along with a redirect.
    """
    where = urlsplit(endpoint)
    hub = (where.scheme, where.hostname, where.port or 443) == ("https", "huggingface.co", 443)
    return None if hub or os.environ.get("HF_TOKEN") else False


def refusal(fault: Any, repository: str, file: str, revision: str) -> str:
    """One line about the hub's error for a file."""
    kind = type(fault).__name__
    if kind == "RemoteEntryNotFoundError":
        return (
            f"hf:{repository} has no {file} at {revision}; name another ONNX file with --file, "
            "or another repository"
        )
    if kind in ("RepositoryNotFoundError", "RevisionNotFoundError", "GatedRepoError"):
        return (
            f"hf:{repository}@{revision} is not there, private or gated; correct the name, or "
            "log in (hf auth login)"
        )
    return f"hf:{repository}: the hub answers {fault.response.status_code} for {file}; {AGAIN}"


def verify_checksum(path: Path) -> Path:
    """A file of the hub's cache, if it has the checksum in its name: sha256, or git's own.

    Raises: InputError naming the file and both checksums.
    """
    if not path.is_symlink():
        raise InputError(
            f"{path} is no link, as the hub's cache has them to files called by their checksums; "
            "set "
            f"HF_HOME to a folder of another disk, and {AGAIN}"
        )
    checksum, blob = path.readlink().name, path.resolve()
    if re.fullmatch(r"[0-9a-f]{64}", checksum):
        digest = sha256_file(blob)
    else:
        data = blob.read_bytes()
        digest = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
    if digest != checksum:
        mismatch = f"{blob} has the checksum {digest}, {checksum} is right"
        raise InputError(f"{mismatch}: damaged on the way; remove it, and {AGAIN}")
    return blob


def document(path: Path) -> dict[str, Any]:
    """A JSON object. Raises InputError naming a file that is none."""
    if not isinstance(values := parse_json(path, AGAIN), dict):
        raise InputError(f"{path} is no JSON object; {AGAIN}")
    return values


def class_names(path: Path, repository: str) -> list[str]:
    """Names of the classes in the order of the channels, unique, as a label file can hold them."""
    named = document(path).get("id2label")
    if (
        not isinstance(named, dict)
        or set(named) != {str(k) for k in range(len(named))}
        or not named
    ):
        raise InputError(
            f"hf:{repository}: config.json names no classes (id2label); a closed-set "
            "segmenter is needed"
        )
    names: list[str] = []
    for k in range(len(named)):
        name = re.sub(r"[:#\s]+", " ", str(named[str(k)])).strip() or f"class {k}"
        names.append(f"{name} ({k})" if name in names else name)
    return names


def preparation(path: Path, repository: str) -> dict[str, Any]:
    """Keys of a teacher's TOML with the effect of the model's image processor.

    Raises: InputError naming a step or a value that no key can replace.
    """
    try:
        return preprocessing_keys(
            {key: value for key, value in document(path).items() if value is not None}
        )
    except ValueError as error:
        why = f"hf:{repository}: {PREPARATION} {error}"
        raise InputError(f"{why}; export the model yourself (docs/teachers.md)") from None


def preprocessing_keys(values: dict[str, Any]) -> dict[str, Any]:
    """Keys of a teacher's TOML from an image processor's values. Raises ValueError.

    Choices: a centre crop becomes the window's size; a photo keeps its aspect ratio.
    """

    def does(step: str, usual: bool) -> bool:
        return bool(values.get(f"do_{step}", usual))

    kind = values.get("image_processor_type", values.get("feature_extractor_type", ""))
    flipped = does("flip_channel_order", "MobileViT" in str(kind))
    others = [
        key for key, value in values.items() if (key.startswith("do_") or "offset" in key) and value
    ]
    if unknown := sorted({*others} - {f"do_{step}" for step in STEPS}):
        raise ValueError(f"asks for {', '.join(unknown)}, which no key of a teacher stands for")
    mean, std = [0.0] * 3, [1.0] * 3
    if does("normalize", not flipped or "image_mean" in values):
        mean, std = (three(values.get(key)) for key in ("image_mean", "image_std"))
        if not mean or not std:
            raise ValueError("has no image_mean or image_std of three numbers")
    factor = values.get("rescale_factor", 1 / 255) if does("rescale", True) else 1
    if not isinstance(factor, int | float) or not 0 < factor < 1e3:
        raise ValueError(f"has a rescale_factor of {factor!r:.40}")
    if flipped and len({*mean}) + len({*std}) > 2:
        raise ValueError(
            "turns the order of channels that are normalised apart (do_flip_channel_order)"
        )
    whole = (
        1 if np.isclose(255 * factor, 1, 1e-9) else 255 * factor
    )  # the value of 255 after rescaling
    if max(*mean, *std) > 1 and whole <= 1:
        raise ValueError(
            "has image_mean or image_std of colours in 0 to 255, and rescales to 0 to 1 before"
        )
    number = values.get("resample", 2)
    if number not in range(len(RESAMPLING)):
        raise ValueError(f"has a resample of {number!r:.40}")
    keys: dict[str, Any] = {"mean": [m / whole for m in mean], "std": [s / whole for s in std]}
    keys |= {"order": "BGR"} if flipped else {}
    keys |= {"resample": RESAMPLING[number]} if number != 2 else {}
    return keys | window_of(values, does("resize", True), does("center_crop", False))


def three(value: Any) -> list[float]:
    """Three numbers from a list or from one number; an empty list otherwise."""
    listed = value if isinstance(value, list) else [value] * 3
    return listed if len(listed) == 3 and all(type(v) in (int, float) for v in listed) else []


def window_of(values: dict[str, Any], resized: bool, cropped: bool) -> dict[str, Any]:
    """`size` and `base` of a TOML: a window's sides and a photo's long side. Raises ValueError."""

    def sides(key: str) -> tuple[list[int], int | None]:
        of = values.get(key)
        of = dict(zip(("height", "width"), of, strict=False)) if isinstance(of, list) else of
        of = of if isinstance(of, dict) else {"shortest_edge": of}
        longest = of.get("longest_edge")
        short = of.get("shortest_edge", longest)
        lengths = [
            side for side in (of.get("height", short), of.get("width", short)) if type(side) is int
        ]
        if len(lengths) < 2 or not isinstance(longest, int | None):
            raise ValueError(f"has no {key} of whole numbers")
        return lengths, longest

    crop = {"size": sides("crop_size")[0]} if cropped else {}
    if not resized:
        return crop
    size, longest = sides("size")
    base = round(max(size) * WIDER)
    return {"size": size, "base": base if longest is None else min(base, longest)} | crop


def check(
    model: Path, photos: Sequence[Path] = (), labels: str | None = None
) -> list[tuple[str, str]]:
    """(topic, finding) of a teacher. Raises as the teacher stage does.

    Args: photos: or folders of them, to test for usual mistakes (`teacher_models/trials.py`); none:
      a view of a generated room; labels: as teacher.labels, None: the teacher's own.
    """
    from chebsplat.stages.teacher_models.image_encoder import TeacherInference
    from chebsplat.stages.teacher_models.trials import try_variants

    settings = TeacherSection()
    teacher = read_teacher(model)
    network = TeacherInference(teacher, n_threads())
    groups = [
        images_below(path, "give another --photo") if path.is_dir() else [path] for path in photos
    ]
    files = [file for of in groups for file in of]
    trial_images = (
        [read_photo(file) for file in files[:: -(-len(files) // N_PHOTOS)]]
        if files
        else [read_photo(None)]
    )
    (name, image), images = trial_images[0], [image for _, image in trial_images]
    grid, n_channels = network.grid(image, settings.downscale)
    if teacher.output == "logits":
        label_names = label_set(teacher, labels, None) if labels else None
        network.judge(images)
        of_classes = network.class_shares(images, grid)
        space = closed_set(teacher, label_names, of_classes, settings.n_channels)
    else:
        space = open_vocabulary(teacher, label_set(teacher, labels, None), n_channels, None)
    start = time.perf_counter()
    _, pseudo_labels, confidence = space.split(
        network.features(image, grid, settings.scales, settings.flips, name)
    )
    seconds = time.perf_counter() - start
    size = network.scaled_size(image, 1.0)
    window = network.window(size)
    counts = np.bincount(pseudo_labels.ravel(), minlength=len(space.names))
    shares = [
        f"{space.names[k]} {counts[k] / pseudo_labels.size:.0%}"
        for k in np.argsort(-counts, kind="stable")[:N_LABELS]
        if counts[k]
    ]
    wide = teacher.output == "features" and n_channels > MAX_CHANNELS
    by = ", as its labels are names alone" if teacher.guessed else ""
    findings = []
    if teacher.output == "logits":
        remark = "" if network.scores == LOGITS else ", told by its values, and taken as such"
        if sureness(float(confidence.mean()), len(space.names)) < UNSURE:
            remark += (
                "; unsure of everything, as of a softmax taken twice or of logits that were "
                "scaled down"
            )
        findings.append(("scores", network.scores + remark))
    if files:
        classes = (
            read_label_table(teacher.labels)[0]
            if teacher.output == "logits" and teacher.labels
            else space.names
        )
        findings += try_variants(network, images, classes, space.embeddings)
    return [
        ("name", f"{teacher.name} ({model}, {model.stat().st_size / 2**20:.1f} MB)"),
        (
            "output",
            f"{teacher.output}{by}, {n_channels} channels"
            + (", reduced to fewer in a scene" if wide else ""),
        ),
        ("image", f"{name}, {image.shape[1]} x {image.shape[0]}, seen at {size[1]} x {size[0]}"),
        (
            "windows",
            f"{n_windows(size, window)} of {window[1]} x "
            f"{window[0]}{'' if network.size else ' (any size)'}",
        ),
        ("map", f"{grid[1]} x {grid[0]}: one feature every {image.shape[0] / grid[0]:.3g} pixels"),
        ("labels", f"{len(space.names)}, from {labels or teacher.labels}"),
        ("seconds", f"{seconds:.2f} a view, on {n_threads()} threads"),
        ("sees", f"{', '.join(shares)} (mean confidence {confidence.mean():.2f})"),
        *findings,
    ]


def n_windows(size: tuple[int, int], window: tuple[int, int]) -> int:
    """The number of windows (H, W) that cover an image (H, W)."""
    rows, columns = (window_starts(n, side) for n, side in zip(size, window, strict=True))
    return len(rows) * len(columns)


def read_photo(photo: Path | None) -> tuple[str, np.ndarray]:
    """(name, image u8 [H, W, 3]) of a photo, or of a view of a generated room."""
    from chebsplat.stages.channels import generated

    if photo is None:
        return next(generated(REFERENCE[:1]))
    return photo.name, read_rgb(photo, "give another --photo")
