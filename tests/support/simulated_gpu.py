"""A GPU that is none: tensors of the CPU, each marked with where it would lie, and a record of what
moves.

FakeTensorMode, which is meant for this, ends the process where a fake CUDA tensor requires a
gradient and torch is built without CUDA. Here values are real, so a whole training runs, backward
and optimizer too, and the rule is torch's: an operation on both devices is an error, unless all
that is on the CPU is a single number.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

aten = torch.ops.aten
GPU = torch.device("cuda", 0)
CPU = torch.device("cpu")
FACTORIES = {
    torch.zeros,
    torch.ones,
    torch.full,
    torch.empty,
    torch.eye,
    torch.arange,
    torch.tensor,
    torch.as_tensor,
}
FACTORIES |= {
    torch.from_numpy,
    torch.rand,
    torch.randn,
    torch.randint,
    torch.randperm,
    torch.linspace,
}
JOINING = {aten.cat.default, aten.stack.default}  # not even a single number may lie elsewhere
INDEXING = {
    aten.index.Tensor,
    aten.index_put_.default,
    aten.index_put.default,
    aten._unsafe_index.Tensor,
}
# `x[i] = 0` in torch 2.15; with i elsewhere, a GPU's takes index_put_
INDEXING |= {aten.index_fill_.int_Scalar}
WAITING = {
    aten.nonzero.default,
    aten._unique2.default,
    aten.masked_select.default,
    aten.unique_consecutive.default,
}
PURGE_EVERY = 5000  # operations
VIEWS = {
    aten.view.default,
    aten.detach.default,
    aten.t.default,
    aten.alias.default,
    aten.expand.default,
}
VIEWS |= {
    aten._unsafe_view.default,
    aten.permute.default,
    aten.transpose.int,
    aten.unsqueeze.default,
}
VIEWS |= {
    aten.select.int,
    aten.slice.Tensor,
    aten.unbind.int,
    aten.as_strided.default,
    aten._reshape_alias.default,
}
VIEWS |= {aten.split.Tensor, aten.split_with_sizes.default, aten.squeeze.dim, aten.squeeze.default}
VIEWS |= {
    aten.empty.memory_format,
    aten.empty_like.default,
    aten.new_empty_strided.default,
    aten.lift_fresh.default,
}


class Moved(NamedTuple):
    """kind: `up` to the GPU, `down` from it, or `wait` for a number of elements that only the GPU
    knows.
    """

    kind: str
    shape: tuple[int, ...]
    what: str


class SimulatedGpu:
    """While `active()`, "cuda" is a device; `moved` records what was copied between it and the CPU,
    and `launches` counts the operations that a GPU computes, a CUDA graph for one.

    Choices: where a tensor lies is kept by storage, so that views and operations in place lie where
      their base does; on the CPU, where nothing is kept. What autograd makes of nothing lies
      nowhere, and fits everything.
    """

    def __init__(self) -> None:
        self.moved: list[Moved] = []
        self.launches = 0
        self.counting = True
        self.places: dict[int, tuple[Any, torch.device | None]] = {}
        self.n_operations = 0

    @contextmanager
    def active(self) -> Iterator[SimulatedGpu]:
        graphed, torch.cuda.make_graphed_callables = torch.cuda.make_graphed_callables, self.graphed
        try:
            with _Functions(self), _Operations(self):
                yield self
        finally:
            torch.cuda.make_graphed_callables = graphed

    def graphed(
        self, function: Any, samples: Any, warm_ups: int = 3, allow_unused_input: bool = False
    ) -> Any:
        """As `torch.cuda.make_graphed_callables`: what it is given is copied, what it returns is
        overwritten.
        """
        kept: dict[str, Tensor] = {}

        def replayed(*arguments: Tensor) -> dict[str, Tensor]:
            for sample, argument in zip(samples, arguments, strict=True):
                if sample.data_ptr() != argument.data_ptr():
                    sample.data.copy_(argument.detach())
            values = self.apart(function, samples, arguments)
            self.launches += 1
            with self.uncounted(), torch.no_grad():
                for name, value in values.items():
                    if name in kept:
                        kept[name].copy_(value)
                        value.data = kept[name]
                    kept[name] = value.detach()
            return values

        return replayed

    def apart(self, function: Any, samples: Any, arguments: Any) -> dict[str, Tensor]:
        """function(*samples), a dictionary, as if of the arguments; what is computed in it and back
        is not counted.
        """
        gpu, names, inner = self, [], []

        class Apart(torch.autograd.Function):
            @staticmethod
            def forward(ctx: Any, *given: Tensor) -> tuple[Tensor, ...]:
                with gpu.uncounted(), torch.enable_grad():
                    values = function(*samples)
                names.extend(values)
                inner.extend(values.values())
                return tuple(value.detach() for value in inner)

            @staticmethod
            def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
                gpu.launches += 1
                learning = [k for k, value in enumerate(inner) if value.requires_grad]
                values, slopes = ([many[k] for k in learning] for many in (inner, grads))
                leaves = [sample for sample in samples if sample.requires_grad]
                with gpu.uncounted():
                    found = torch.autograd.grad(values, leaves, slopes, allow_unused=True)
                return tuple(
                    dict(zip(map(id, leaves), found, strict=True)).get(id(sample))
                    for sample in samples
                )

        return dict(zip(names, Apart.apply(*arguments), strict=True))

    @contextmanager
    def uncounted(self) -> Iterator[None]:
        """What moves within is not recorded: it is not ours."""
        before, self.counting = self.counting, False
        try:
            yield
        finally:
            self.counting = before

    def place(self, tensor: Tensor) -> torch.device | None:
        """Where a tensor lies; None: nowhere."""
        with torch._C.DisableTorchFunction():
            held = self.places.get(tensor.untyped_storage()._cdata)
        return CPU if held is None else held[1]

    def put(self, tensor: Tensor, place: torch.device | None, over: bool = False) -> None:
        with torch._C.DisableTorchFunction():
            storage = tensor.untyped_storage()
        if over or storage._cdata not in self.places:
            self.places[storage._cdata] = (storage, place)

    def record(self, kind: str, tensor: Tensor, what: str) -> None:
        if self.counting:
            frame = sys._getframe(1)
            while (
                frame.f_back is not None
                and frame.f_globals.get("__name__", "").partition(".")[0] != "chebsplat"
            ):
                frame = frame.f_back
            with torch._C.DisableTorchFunction():
                self.moved.append(
                    Moved(kind, tuple(tensor.shape), f"{what} in {frame.f_code.co_qualname}")
                )

    def purge(self) -> None:
        """Forget storages that nobody else holds."""
        count = torch._C._storage_Use_Count
        self.places = {key: held for key, held in self.places.items() if count(key) > 1}


class _Operations(TorchDispatchMode):
    def __init__(self, gpu: SimulatedGpu) -> None:
        super().__init__()
        self.gpu = gpu

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        gpu, kwargs = self.gpu, kwargs or {}
        gpu.n_operations += 1
        if gpu.n_operations % PURGE_EVERY == 0:
            gpu.purge()
        inputs = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        places = [gpu.place(tensor) for tensor in inputs]
        on_gpu = GPU in places
        gpu.launches += gpu.counting and on_gpu and func not in VIEWS
        if on_gpu and CPU in places:
            self._check(func, args, inputs, places)
        if on_gpu and func in (aten._local_scalar_dense.default, aten.equal.default):
            gpu.record("down", inputs[0], str(func))
        if on_gpu and (func in WAITING or (func in INDEXING and _by_mask(args[1]))):
            gpu.record("wait", inputs[0], str(func))
        with torch._C.DisableTorchFunction():  # in backward, torch 2.7 would ask `_Functions` again
            out = func(*args, **kwargs)
        given = {tensor.untyped_storage()._cdata for tensor in inputs}
        for tensor in tree_leaves(out):
            fresh = isinstance(tensor, Tensor) and tensor.untyped_storage()._cdata not in given
            if fresh and (on_gpu or CPU not in places):
                gpu.put(tensor, GPU if on_gpu else None)
        return out

    def _check(
        self, func: Any, args: Any, inputs: list[Tensor], places: list[torch.device | None]
    ) -> None:
        aside = [tensor for tensor, place in zip(inputs, places, strict=True) if place == CPU]
        if func is aten.copy_.default:
            self.gpu.record("up" if places[0] == GPU else "down", inputs[1], str(func))
        elif func in INDEXING and places[0] == GPU:
            for tensor in aside:
                if tensor.ndim:
                    self.gpu.record("up", tensor, str(func))
        elif (
            func in JOINING
            or any(tensor.ndim for tensor in aside)
            or (places[0] == CPU and func._schema.is_mutable)
        ):
            shapes = [
                f"{tuple(t.shape)} on {place}" for t, place in zip(inputs, places, strict=True)
            ]
            raise RuntimeError(f"{func} mixes devices: {', '.join(shapes)}")


class _Functions(TorchFunctionMode):
    def __init__(self, gpu: SimulatedGpu) -> None:
        super().__init__()
        self.gpu = gpu

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        gpu, kwargs = self.gpu, dict(kwargs or {})
        if func == Tensor.device.__get__:  # type: ignore[attr-defined]
            return gpu.place(args[0]) or CPU
        if func == Tensor.is_cuda.__get__:  # type: ignore[attr-defined]
            return gpu.place(args[0]) == GPU
        if func is Tensor.backward:
            with self:
                return torch.autograd.backward(args[0], kwargs.pop("gradient", None), **kwargs)
        if func in (Tensor.numpy, Tensor.__array__) and gpu.place(args[0]) == GPU:
            raise TypeError(
                "can't convert cuda:0 device type tensor to numpy; copy it to the CPU first"
            )
        if func is Tensor.tolist and gpu.place(args[0]) == GPU:
            gpu.record("down", args[0], "tolist")
        if func in (Tensor.to, Tensor.cpu, Tensor.cuda, Tensor.type_as):
            return self._to(func, args, kwargs)
        device = kwargs.get("device")
        if device is not None:
            kwargs["device"] = "cpu"
        made = func(*args, **kwargs)
        if func in FACTORIES and isinstance(made, Tensor):
            given = args[0] if args and isinstance(args[0], Tensor) else None
            if given is None or device is not None:
                gpu.put(
                    made,
                    torch.device(device or "cpu") if device is None else _full(device),
                    over=True,
                )
        elif func is Tensor.new_tensor:
            gpu.put(
                made, _full(device) if device is not None else gpu.place(args[0]) or CPU, over=True
            )
            if gpu.place(made) == GPU:
                gpu.record("up", made, "new_tensor")
        elif device is not None and isinstance(made, Tensor):
            gpu.put(made, _full(device), over=True)
        return made

    def _to(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Tensor:
        """`.to` and its like: a copy where the device is another one, and autograd follows it."""
        tensor, rest = args[0], list(args[1:])
        target, dtype = self.gpu.place(tensor) or CPU, kwargs.get("dtype")
        if func is Tensor.cpu:
            target = CPU
        elif func is Tensor.cuda:
            target = GPU
        for word in (*rest, kwargs.get("device"), kwargs.get("other")):
            if isinstance(word, Tensor):
                target, dtype = self.gpu.place(word) or CPU, word.dtype
            elif isinstance(word, str | torch.device):
                target = _full(word)
            elif isinstance(word, torch.dtype):
                dtype = word
        moved = tensor if dtype is None or dtype == tensor.dtype else tensor.to(dtype)
        if target != (self.gpu.place(tensor) or CPU):
            self.gpu.record("up" if target == GPU else "down", tensor, func.__name__)
            moved = moved.clone()
            self.gpu.put(moved, target, over=True)
        elif kwargs.get("copy"):
            moved = moved.clone()
        return moved


def _by_mask(index: Any) -> bool:
    return any(isinstance(part, Tensor) and part.dtype == torch.bool for part in tree_leaves(index))


def _full(device: str | torch.device) -> torch.device:
    return GPU if torch.device(device).type == "cuda" else CPU
