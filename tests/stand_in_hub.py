"""A stand-in of the Hugging Face hub on 127.0.0.1: one repository, whose large file lies behind a redirect."""

import hashlib
import json
import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
from onnx import helper
from tiny_teachers import write_model

REPOSITORY, COMMIT, CLASSES = "some/Segmenter-B0", "c" * 40, ["wall", "floor", "sofa: a seat", "wall"]
PREPARATION = {"size": {"height": 64, "width": 64}, "image_mean": [0.485, 0.456, 0.406], "image_std": [0.2, 0.2, 0.2]}


def files(folder):
    """name: bytes, of a segmenter whose logits are [1, C, h / 4, w / 4], as segformer's."""
    padding = (
        np.random.default_rng(1).normal(size=100_000).astype(np.float32)
    )  # so that there is something to break off
    kernel = np.random.default_rng(0).normal(size=(len(CLASSES), 3, 4, 4)).astype(np.float32)
    node = helper.make_node("Conv", ["image", "kernel"], ["logits"], strides=[4, 4])
    shape = ("batch_size", "num_channels", "height", "width")
    write_model(folder / "served.onnx", [node], ("logits",), shape, constants={"kernel": kernel, "padding": padding})
    return {
        "config.json": json.dumps({"id2label": {str(k): name for k, name in enumerate(CLASSES)}}).encode(),
        "preprocessor_config.json": json.dumps(PREPARATION).encode(),
        "onnx/model.onnx": (folder / "served.onnx").read_bytes(),
    }


class Hub:
    """files: name -> bytes; sums: checksums that are told, where they differ from the true ones.

    cut: bytes of the large file after which a connection ends; asked: (method, path) of every request;
    revisions: those that are there.
    """

    def __init__(self, served):
        self.files, self.sums, self.cut, self.asked = served, {}, None, []
        self.revisions = ("main", COMMIT)

    def checksum(self, name):
        data = self.files[name]
        true = hashlib.sha256(data) if name.endswith(".onnx") else hashlib.sha1(b"blob %d\0" % len(data) + data)
        return self.sums.get(name, true.hexdigest())


@contextmanager
def serving(hub):
    """The hub's address, while it answers."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_):
            pass

        def answer(self, code, headers, body=b""):
            self.send_response(code)
            for name, value in {"Content-Length": len(body), **headers}.items():
                self.send_header(name, str(value))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(body)

        def do_HEAD(self):
            hub.asked.append((self.command, self.path))
            found = re.fullmatch(rf"/{REPOSITORY}/resolve/(\w+)/(.+)", self.path)
            if self.path.startswith("/large/"):
                data = hub.files[self.path.removeprefix("/large/")]
                self.close_connection = True
                return self.answer(200, {"Content-Length": len(data)}, data[: hub.cut])
            if not self.path.startswith(f"/{REPOSITORY}/"):
                return self.answer(401, {"X-Error-Code": "RepoNotFound"})
            if found and found[1] not in hub.revisions:
                return self.answer(404, {"X-Error-Code": "RevisionNotFound"})
            if not found or found[2] not in hub.files:
                return self.answer(404, {"X-Error-Code": "EntryNotFound", "X-Repo-Commit": COMMIT})
            name, known = found[2], {"X-Repo-Commit": COMMIT}
            if not name.endswith(".onnx"):
                return self.answer(200, known | {"ETag": f'"{hub.checksum(name)}"'}, hub.files[name])
            known |= {"X-Linked-Etag": f'"{hub.checksum(name)}"', "X-Linked-Size": len(hub.files[name])}
            return self.answer(302, known | {"Location": f"{elsewhere}/large/{name}"})

        do_GET = do_HEAD

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    address = f"http://127.0.0.1:{server.server_port}"
    elsewhere = f"http://localhost:{server.server_port}"  # by its other name: a redirect within the hub is followed
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield address
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
