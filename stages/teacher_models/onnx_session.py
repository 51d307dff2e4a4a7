"""Users' ONNX models, run here alone, with limits on outputs, time and memory.

onnxruntime itself refuses weights outside the model's folder.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Mapping
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.onnx_files import model_files

SECONDS = 600.0  # of one run, of a window or of a text
LOOPING = 10.0  # of one run of a model with a Loop or a Scan: only such a one may never end
LARGEST = 1 << 30  # bytes of one output, where the graph declares them
LEAST, MOST = 1 << 29, 1 << 32  # bytes that a run may take beside the weights
BYTES = 4096  # of these, for each input value: the embedded teacher takes 330, MOSAIC 50
FOLDED = 1 << 26  # bytes of a constant that is folded when a model is opened
OVER = "Available memory of"  # in onnxruntime's error where a run would take more
CUDA = "CUDAExecutionProvider"
GPU_REMEDY = "`.venv/bin/pip install onnxruntime-gpu` in the place of onnxruntime adds it"
LOOPS = (b'"\x04Loop', b'"\x04Scan')  # as protobuf writes a node's operator


class Model:
    """An ONNX model in onnxruntime, on the CPU or, with device cuda and a build for it, on a GPU.

    Args: remedy: for messages; options: onnxruntime's SessionOptions; device: cpu or cuda.
    Raises: InputError naming the file.
    """

    def __init__(self, path: Path, remedy: str, options: Any = None, device: str = "cpu"):
        import onnxruntime

        self.path, self.remedy = Path(path), remedy
        model_files(self.path)  # raises an error that names a missing file
        self._options, self._providers = options or onnxruntime.SessionOptions(), providers(device)
        self._options.log_severity_level = 4  # errors are raised, and reported once
        self._options.add_session_config_entry("session.use_env_allocators", "1")
        folding = "optimization.constant_folding_max_output_size_in_bytes"
        self._options.add_session_config_entry(folding, str(FOLDED))
        try:
            self._open(LEAST)
        except Exception as error:  # onnxruntime's own exception types are not public
            raise InputError(
                f"{path} is not a usable ONNX model ({_line(error)}); {remedy}"
            ) from None
        self.inputs: list[Any] = self._session.get_inputs()
        self.outputs: list[Any] = self._session.get_outputs()
        if not self.inputs or not self.outputs:
            what = "output" if self.inputs else "input"
            raise InputError(f"{path} has no {what}: nothing can be asked of it; {remedy}")
        for entry in self.outputs:
            declared = 4 * math.prod(side for side in entry.shape or () if isinstance(side, int))
            if declared > LARGEST:
                raise InputError(
                    f"{path} gives {entry.shape}, {declared:,} bytes; at most "
                    f"{LARGEST:,} are possible"
                )
        self.seconds = LOOPING if _loops(self.path) else SECONDS

    def _open(self, memory: int) -> None:
        """Open a session whose runs may take so many bytes. The limit is of the arena that it is
        opened with; earlier sessions keep theirs.
        """
        import onnxruntime

        self._session: Any = None  # its memory goes first
        kinds = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, onnxruntime.OrtMemType.DEFAULT
        # grow by requests, not by doubling
        limit = onnxruntime.OrtArenaCfg({"max_mem": memory, "arena_extend_strategy": 1})
        onnxruntime.create_and_register_allocator(
            onnxruntime.OrtMemoryInfo("Cpu", kinds[0], 0, kinds[1]), limit
        )
        self._session = onnxruntime.InferenceSession(
            str(self.path), self._options, providers=self._providers
        )
        self.memory = memory

    def run(self, feeds: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """All outputs. Raises InputError if the model fails, or takes too much time or memory.

        Choices: memory grows with the inputs, from LEAST to MOST; for more the model is reopened.
        """
        import onnxruntime

        memory = min(LEAST + BYTES * sum(value.size for value in feeds.values()), MOST)
        if memory > self.memory:
            self._open(memory)
        options = onnxruntime.RunOptions()
        late = Timer(self.seconds, lambda: setattr(options, "terminate", True))
        late.daemon = True
        late.start()
        try:
            outputs = self._session.run(None, dict(feeds), options)
        except Exception as error:  # onnxruntime's own exception types are not public
            why = f"not done after {self.seconds:g} s" if options.terminate else _line(error)
            why = (
                f"more than {self.memory:,} bytes of memory are needed"
                if OVER in str(error)
                else why
            )
            sizes = ", ".join(str(list(value.shape)) for value in feeds.values())
            raise InputError(f"{self.path} fails on {sizes} ({why}); {self.remedy}") from None
        finally:
            late.cancel()
        if not all(
            isinstance(value, np.ndarray) and value.dtype.kind in "fiub" for value in outputs
        ):
            raise InputError(f"{self.path} gives more than tensors of numbers; {self.remedy}")
        return outputs


def providers(device: str) -> list[str]:
    """onnxruntime's execution providers of a device, best first: CUDA only if it has that."""
    import onnxruntime

    on_gpu = [CUDA] if device == "cuda" and CUDA in onnxruntime.get_available_providers() else []
    return [*on_gpu, "CPUExecutionProvider"]


def _loops(path: Path) -> bool:
    with path.open("rb") as handle, mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return any(data.find(operator) >= 0 for operator in LOOPS)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
