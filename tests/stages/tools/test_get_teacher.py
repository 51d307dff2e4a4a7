"""Teachers from a stand-in of the hub: whole, interrupted, damaged, out of reach. The hub itself is
never asked.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from onnx import helper
from tiny_teachers import moved_out, write_model, write_settings

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.teacher_model import read_teacher
from chebsplat.stages.teacher_models.image_encoder import TeacherInference
from chebsplat.stages.tools.get_teacher import check, get_teacher, parsed, preparation, token_for

REPOSITORY, COMMIT, CLASSES = (
    "some/Segmenter-B0",
    "c" * 40,
    ["wall", "floor", "sofa: a seat", "wall"],
)
NAME, SHORT = f"hf:{REPOSITORY}", "segmenter-b0"
PREPARATION = {
    "size": {"height": 64, "width": 64},
    "image_mean": [0.485, 0.456, 0.406],
    "image_std": [0.2, 0.2, 0.2],
}


def segmenter(path):
    """Bytes of a segmenter whose logits are [1, C, h / 4, w / 4], and that is large enough to break
    off.
    """
    rng = np.random.default_rng(0)
    constants = {
        "kernel": rng.normal(size=(len(CLASSES), 3, 4, 4)),
        "padding": rng.normal(size=100_000),
    }
    constants = {name: values.astype(np.float32) for name, values in constants.items()}
    node = helper.make_node("Conv", ["image", "kernel"], ["logits"], strides=[4, 4])
    shape = ("batch_size", "num_channels", "height", "width")
    write_model(path, [node], ("logits",), shape, constants=constants)
    return path.read_bytes()


class Hub(ThreadingHTTPServer):
    """Of one repository, whose checksums may be false (`sums`) and whose answers are `cut`;
    `asked`: its requests.

    store: the origin that it sends on to for large files; tokens: those that came with requests.
    """

    daemon_threads = True

    def __init__(self, folder):
        super().__init__(("127.0.0.1", 0), Answer)
        self.address = f"http://127.0.0.1:{self.server_port}"
        self.sums, self.cut, self.asked, self.revisions = {}, None, [], ("main", COMMIT)
        self.store, self.tokens = None, []
        self.files = {
            "config.json": json.dumps({"id2label": dict(enumerate(CLASSES))}).encode(),
            "preprocessor_config.json": json.dumps(PREPARATION).encode(),
            "onnx/model.onnx": segmenter(folder / "served.onnx"),
        }

    def checksum(self, name):
        data = self.files[name]
        true = (
            hashlib.sha256(data)
            if name.endswith(".onnx")
            else hashlib.sha1(b"blob %d\0" % len(data) + data)
        )
        return self.sums.get(name, true.hexdigest())


class Answer(BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def do_HEAD(self):
        hub = self.server
        hub.asked.append((self.command, self.path))
        hub.tokens.append(self.headers.get("Authorization"))
        found = re.fullmatch(rf"/{REPOSITORY}/resolve/(\w+)/(.+)", self.path)
        code, headers, data = 200, {"X-Repo-Commit": COMMIT}, b""
        if not found:
            code, headers = 401, {"X-Error-Code": "RepoNotFound"}
        elif found[1] not in hub.revisions:
            code, headers = 404, {"X-Error-Code": "RevisionNotFound"}
        elif found[2] not in hub.files:
            code, headers = 404, {"X-Error-Code": "EntryNotFound"}
        else:
            data = hub.files[found[2]]
            headers |= {"ETag": f'"{hub.checksum(found[2])}"'}
            if hub.store is not None and found[2].endswith(".onnx"):
                linked = {"X-Linked-ETag": headers["ETag"], "X-Linked-Size": str(len(data))}
                code, data = 302, b""
                headers |= linked | {"Location": hub.store + self.path}
        self.send_response(code)
        for header in {"Content-Length": str(len(data)), **headers}.items():
            self.send_header(*header)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(data[: hub.cut])

    do_GET = do_HEAD


@pytest.fixture
def constants():
    return pytest.importorskip(
        "huggingface_hub.constants", reason="the extra `hub` is not installed"
    )


@pytest.fixture
def hub(constants, tmp_path, monkeypatch):
    """A hub that answers, an empty cache, and a small photo for the check."""
    photo = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    monkeypatch.setattr("chebsplat.stages.tools.get_teacher.read_photo", lambda _: ("photo", photo))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("time.sleep", lambda _: None)  # where the client waits, and tries again
    monkeypatch.chdir(tmp_path)
    with Hub(tmp_path) as found:
        threading.Thread(target=found.serve_forever, daemon=True).start()
        ask(constants, monkeypatch, found.address)
        yield found
        found.shutdown()


def ask(constants, monkeypatch, address):
    """As HF_ENDPOINT would, which the client reads when it is imported."""
    template = constants.HUGGINGFACE_CO_URL_TEMPLATE.removeprefix(constants.ENDPOINT)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + template)
    monkeypatch.setattr(constants, "ENDPOINT", address)


NORM = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
SIZED = {"size": {"height": 64, "width": 64}}


def usual(v, m, s):
    return (v / 255 - m) / s


# of preprocessor_config.json: other keys, what the hub's processor makes of colours 0 to 255, keys
# of the TOML
FED = {
    "as usual": (NORM, usual, {"mean": [0.485, 0.456, 0.406]}),
    "said in full": (
        NORM | {"do_rescale": True, "rescale_factor": 0.00392156862745098, "do_normalize": True,
                "do_pad": True},
        usual, {},
    ),
    "not normalised": (NORM | {"do_normalize": False}, lambda v, m, s: v / 255, {"std": [1, 1, 1]}),
    "not rescaled": (
        {"do_rescale": False, "image_mean": [123.675, 116.28, 103.53],
         "image_std": [58.395, 57.12, 57.375]},
        lambda v, m, s: (v - m) / s, {},
    ),
    "neither": ({"do_rescale": False, "do_normalize": False}, lambda v, m, s: v, {}),
    "rescaled to 0 to 2": (NORM | {"rescale_factor": 1 / 127.5}, lambda v, m,
                           s: (v / 127.5 - m) / s, {}),
    "rescaled to less than 1": ({"rescale_factor": 1 / 256, "do_normalize": False}, lambda v, m,
                                s: v / 256, {}),
    "one number for three": ({"image_mean": 0.5, "image_std": 0.5}, lambda v, m, s: v / 127.5 - 1,
                             {}),
    "BGR": ({"do_flip_channel_order": True}, lambda v, m, s: v[::-1] / 255, {"order": "BGR"}),
    "MobileViT, which is of BGR unless it says otherwise": (
        {"image_processor_type": "MobileViTImageProcessor"}, lambda v, m, s: v[::-1] / 255,
        {"order": "BGR"},
    ),
    "bicubic": (NORM | {"resample": 3}, usual, {"resample": "bicubic"}),
    "the shortest edge": (NORM | {"size": {"shortest_edge": 96}}, usual,
                          {"size": [96, 96], "base": 128}),
    "the longest edge": (NORM | {"size": {"shortest_edge": 96, "longest_edge": 100}}, usual,
                         {"base": 100}),
    "a crop": (
        NORM | {"size": {"shortest_edge": 96}, "do_center_crop": True, "crop_size": 64},
        usual, {"size": [64, 64], "base": 128},
    ),
}  # fmt: skip


def written(tmp_path, values):
    path = tmp_path / "preprocessor_config.json"
    path.write_text(json.dumps(SIZED | values))
    return preparation(path, REPOSITORY)


@pytest.mark.parametrize("case", FED)
def test_a_model_is_fed_what_the_hub_s_own_processor_would_feed_it(tmp_path, case):
    values, processed, keys = FED[case]
    found = written(tmp_path, values)
    assert {key: found[key] for key in keys} == keys
    write_model(tmp_path / "tiny.onnx", [helper.make_node("Identity", ["image"], ["features"])])
    write_settings(tmp_path / "tiny.onnx", **found)
    colors = np.arange(0, 256, 17, dtype=np.uint8)
    window = np.stack([colors, colors[::-1], np.roll(colors, 5)], 1)[None]
    fed = TeacherInference(read_teacher(tmp_path / "tiny.onnx"), 1).run(window, "view")
    mean, std = (np.reshape(values.get(key, 0), (-1, 1, 1)) for key in ("image_mean", "image_std"))
    wanted = processed(window.transpose(2, 0, 1).astype(float), mean, std)
    assert np.allclose(fed, wanted, atol=1e-5 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("values", "word"),
    [
        (NORM | {"do_thumbnail": True}, "do_thumbnail"),
        (NORM | {"do_grayscale": True, "rescale_offset": True}, "do_grayscale, rescale_offset"),
        (NORM | {"do_flip_channel_order": True}, "do_flip_channel_order"),
        (NORM | {"rescale_factor": "1/255"}, "rescale_factor of '1/255'"),
        (NORM | {"resample": 9}, "resample of 9"),
        (NORM | {"size": {"width": 64}}, "no size of whole numbers"),
        (NORM | {"do_center_crop": True}, "no crop_size"),
        (
            {"image_mean": [123.675, 116.28, 103.53], "image_std": [58.395, 57.12, 57.375]},
            "of colours in 0 to 255",
        ),
        (
            {"image_mean": [0.5, 0.5], "image_std": [0.5, 0.5]},
            "no image_mean or image_std of three numbers",
        ),
    ],
)
def test_what_no_key_of_a_teacher_stands_for_is_refused_by_name(tmp_path, values, word):
    with pytest.raises(
        InputError,
        match=rf"{REPOSITORY}: preprocessor_config.json .*{word}.*; "
        r"export",
    ):
        written(tmp_path, values)


def test_weights_beside_a_graph_come_along_and_count_in_its_checksum(tmp_path, monkeypatch):
    """Without the hub's client, which the other tests need."""
    held = tmp_path / "hub"
    (held / "onnx").mkdir(parents=True)
    segmenter(held / "onnx/model.onnx")
    moved_out(held / "onnx/model.onnx", "model.onnx_data")
    (held / "config.json").write_text(json.dumps({"id2label": dict(enumerate(CLASSES))}))
    (held / "preprocessor_config.json").write_text(json.dumps(PREPARATION))
    monkeypatch.setattr(
        "chebsplat.stages.tools.get_teacher.fetch_file",
        lambda repository, file, revision: held / file,
    )
    model, _ = get_teacher(NAME, tmp_path / "out")
    assert (tmp_path / "out/model.onnx_data").is_file()
    check(model)
    with (tmp_path / "out/model.onnx_data").open("r+b") as weights:
        weights.write(b"\1")
    with pytest.raises(InputError, match="damaged or replaced"):
        check(model)


def test_a_repository_becomes_a_teacher_of_three_files(hub, tmp_path):
    model, findings = get_teacher(NAME)
    assert sorted(p.name for p in (tmp_path / SHORT).iterdir()) == [
        f"{SHORT}.{kind}" for kind in ("onnx", "toml", "txt")
    ]
    assert not list(tmp_path.glob(".part-*"))
    assert model.read_bytes() == hub.files["onnx/model.onnx"]
    teacher = read_teacher(model)
    assert (teacher.output, teacher.size, teacher.base) == ("logits", (64, 64), 85)
    assert teacher.mean == (0.485, 0.456, 0.406)
    assert (
        teacher.sha256 == hub.checksum("onnx/model.onnx")
        and teacher.origin == f"{NAME}@main/onnx/model.onnx"
    )
    assert (tmp_path / SHORT / f"{SHORT}.txt").read_text().splitlines() == [
        "wall",
        "floor",
        "sofa a seat",
        "wall (3)",
    ]
    assert "logits, 4 channels" in dict(findings)["output"]
    hub.asked.clear()
    assert get_teacher(NAME)[0] == model  # there already
    assert hub.asked == []


def test_a_download_that_broke_off_leaves_nothing_half(hub, tmp_path):
    hub.cut = 200_000
    with pytest.raises(
        InputError,
        match=r"onnx/model.onnx broke off \(.*\); run the same command "
        r"again",
    ):
        get_teacher(NAME)
    assert not list(tmp_path.glob("*segmenter*")) and not list(tmp_path.rglob("*.incomplete"))
    hub.cut, _ = None, hub.asked.clear()
    model, _ = get_teacher(NAME)
    assert model.read_bytes() == hub.files["onnx/model.onnx"]
    got = [path for method, path in hub.asked if method == "GET"]
    assert got == [f"/{REPOSITORY}/resolve/main/onnx/model.onnx"]  # and the small files not again


@pytest.mark.parametrize("name", ["onnx/model.onnx", "config.json"])
def test_a_wrong_checksum_is_refused_and_its_file_named(hub, tmp_path, name):
    hub.sums[name] = "0" * len(hub.checksum(name))
    with pytest.raises(
        InputError, match=r"has the checksum \w+, 0+ is right: damaged .*; remove it"
    ) as error:
        get_teacher(NAME)
    assert not (tmp_path / SHORT).exists()
    del hub.sums[name]
    Path(str(error.value).split(" has the checksum")[0]).unlink()
    assert get_teacher(NAME)[0].is_file()


def test_a_revision_stays_pinned_and_what_the_cache_has_of_it_is_not_fetched_again(hub, tmp_path):
    hub.revisions = (COMMIT,)
    with pytest.raises(InputError, match=f"{REPOSITORY}@main is not there"):
        get_teacher(NAME)
    get_teacher(f"{NAME}@{COMMIT}", tmp_path / "a")
    hub.asked.clear()
    model, _ = get_teacher(f"{NAME}@{COMMIT}", tmp_path / "b")
    assert read_teacher(model).origin == f"{NAME}@{COMMIT}/onnx/model.onnx"
    assert hub.asked == []


def test_an_encoder_that_was_replaced_later_is_refused(hub):
    model, _ = get_teacher(NAME)
    with model.open("ab") as handle:
        handle.write(b"\0")
    with pytest.raises(InputError, match="damaged or replaced"):
        check(model)
    with pytest.raises(InputError, match="damaged or replaced"):
        get_teacher(NAME)
    assert model.is_file()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda files: files.pop("onnx/model.onnx"),
            "has no onnx/model.onnx at main; name another ONNX file",
        ),
        (lambda files: files.update({"config.json": b"{}"}), "names no classes"),
        (lambda files: files.update({"config.json": b"[]"}), "is no JSON object"),
        (lambda files: files.update({"preprocessor_config.json": b"{}"}), "image_mean"),
        (lambda files: files.update({"onnx/model.onnx": b"no graph"}), "onnx"),
        (lambda files: files.update({"config.json": b'{"id2label": {"0": "wall"}}'}), "4 channels"),
    ],
)
def test_a_repository_that_holds_no_teacher_is_one_line_and_leaves_no_folder(
    hub, tmp_path, change, message
):
    change(hub.files)
    with pytest.raises(InputError, match=message) as error:
        get_teacher(NAME)
    assert "\n" not in str(error.value)
    assert not (tmp_path / SHORT).exists()


def test_a_repository_that_is_not_there_and_a_folder_of_something_else(hub, tmp_path):
    with pytest.raises(InputError, match="is not there, private or gated"):
        get_teacher("hf:some/other")
    (tmp_path / SHORT).mkdir()
    with pytest.raises(ConfigError, match="exists and is not"):
        get_teacher(NAME)


@pytest.mark.parametrize(
    ("endpoint", "named", "sent"),
    [
        ("https://huggingface.co", "", True),
        ("https://huggingface.co:443", "", True),
        ("http://huggingface.co", "", False),
        ("https://huggingface.co:444", "", False),
        ("https://huggingface.co.example.org", "", False),
        ("https://huggingface.co@example.org", "", False),
        ("https://huggingface.com", "", False),
        ("https://hub.example.org", "", False),
        ("https://hub.example.org", "hf_mine", True),
    ],
)
def test_the_token_of_a_login_goes_to_the_hub_s_own_origin_alone(
    monkeypatch, endpoint, named, sent
):
    monkeypatch.setenv("HF_TOKEN", named)
    assert token_for(endpoint) is (None if sent else False)


@pytest.mark.parametrize("named", ["", "hf_mine"])
def test_no_token_follows_to_another_origin(hub, tmp_path, monkeypatch, named):
    (tmp_path / "token").write_text("hf_of_a_login")
    monkeypatch.setattr("huggingface_hub.constants.HF_TOKEN_PATH", str(tmp_path / "token"))
    monkeypatch.setenv("HF_TOKEN", named)
    with Hub(tmp_path) as store:
        threading.Thread(target=store.serve_forever, daemon=True).start()
        hub.store = store.address
        assert get_teacher(NAME)[0].is_file()
        store.shutdown()
    assert store.asked and set(store.tokens) == {None}
    assert set(hub.tokens) == ({f"Bearer {named}"} if named else {None})


def test_names():
    assert parsed("segformer-b0-ade") == (
        "Xenova/segformer-b0-finetuned-ade-512-512",
        "main",
        "segformer-b0-ade",
    )
    assert parsed("hf:some/Segmenter-B0@v1") == ("some/Segmenter-B0", "v1", "segmenter-b0")
    for wrong in ("segformer", "hf:one", "hf:a/b/c", "hf:../..//x"):
        with pytest.raises(ConfigError, match="segformer-b0-ade"):
            parsed(wrong)


def command(tmp_path, *arguments, **environment):
    environment = (
        os.environ
        | {"HF_HOME": str(tmp_path / "hf"), "HF_HUB_DISABLE_PROGRESS_BARS": "1"}
        | environment
    )
    call = [sys.executable, "-m", "chebsplat.pipelines.cli", "get-teacher", *arguments]
    return subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True)


def test_the_command_takes_the_hub_that_the_environment_names(hub, tmp_path):
    done = command(tmp_path, NAME, "--out", "mine", HF_ENDPOINT=hub.address)
    assert (done.returncode, done.stdout) == (0, f"mine/{SHORT}.onnx\n"), done.stderr
    assert "teacher.model=mine/" in done.stderr and "sees" in done.stderr


def test_without_a_network_the_cache_serves_and_what_it_has_not_is_one_line_with_its_remedy(
    hub, constants, tmp_path, monkeypatch
):
    get_teacher(NAME, tmp_path / "a")
    ask(constants, monkeypatch, "http://127.0.0.1:9")
    assert get_teacher(NAME, tmp_path / "b")[0].is_file()
    with pytest.raises(
        InputError,
        match=r"cache and http://127.0.0.1:9 is not reached; connect, "
        r"or set HF_ENDPOINT",
    ):
        get_teacher("segformer-b0-ade")
    done = command(tmp_path, "segformer-b0-ade", HF_HUB_OFFLINE="1")
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (3, "", 1)
    assert "is not in the hub's cache and HF_HUB_OFFLINE is set; connect" in done.stderr
    assert not (tmp_path / "segformer-b0-ade").exists()
