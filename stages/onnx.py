"""onnx: export the local encoder, and check it against torch at several region counts and sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from chebsplat.errors import DataFailure
from chebsplat.stages.command import Job, command

SIZES = ((1, 1), (3, 8), (16, 32), (5, 64))  # (regions, members) that parity is measured at


def run(job: Job) -> None:
    from chebsplat.encoder import RegionEncoder
    from chebsplat.formats.encoder import write_encoder
    from chebsplat.formats.gaussians import read_gaussians

    encoder = RegionEncoder.restored(*read_gaussians(job.inputs["gaussians"]).encoder())
    export(encoder, job.out / "encoder.onnx", job.config.onnx.opset)
    parity = compare(encoder, job.out / "encoder.onnx")
    worst = max(row["difference"] for row in parity)
    if not worst <= job.config.onnx.tolerance:
        raise DataFailure(f"ONNX differs from torch by {worst:.1e}; onnx.tolerance is {job.config.onnx.tolerance:.1e}")
    job.facts |= {"largest_difference": worst}
    write_encoder(job.out, contract(encoder), parity)


def example(encoder: Any, n_regions: int, n_members: int, seed: int = 0) -> tuple[Any, Any, Any]:
    """Random inputs of a size; the last member of every second region is padding."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    inputs = torch.randn(n_regions, n_members, encoder.n_inputs, generator=generator)
    positions = 2 * torch.rand(n_regions, n_members, 3, generator=generator) - 1
    mask = torch.ones(n_regions, n_members, dtype=torch.bool)
    if n_members > 1:
        mask[::2, -1] = False
    return inputs, positions, mask


def export(encoder: Any, path: Path, opset: int) -> None:
    """One self-contained file with dynamic region count and size."""
    import io
    import logging
    import warnings
    from contextlib import redirect_stdout

    import onnx  # noqa: F401  # torch's exporter loads these two; named, their versions are part of the stage's key
    import onnxscript  # noqa: F401
    import torch

    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel("ERROR")  # "torchvision is absent"
    regions, members = torch.export.Dim("regions", min=1), torch.export.Dim("members", min=1)
    shape = {0: regions, 1: members}
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")  # the exporter warns about its own internals
        torch.onnx.export(
            encoder,
            example(encoder, 4, 6),
            path,
            input_names=["inputs", "positions", "mask"],
            output_names=["encodings"],
            opset_version=opset,
            dynamo=True,
            dynamic_shapes=(shape, shape, shape),
            external_data=False,
            verbose=False,
        )


def compare(encoder: Any, path: Path) -> list[dict[str, float]]:
    """Largest absolute difference between onnxruntime and torch at each of SIZES."""
    import onnxruntime
    import torch

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    known = {entry.name for entry in session.get_inputs()}
    rows = []
    for n_regions, n_members in SIZES:
        values = example(encoder, n_regions, n_members, seed=n_members)
        feed = {k: v.numpy() for k, v in zip(("inputs", "positions", "mask"), values, strict=True) if k in known}
        found = torch.from_numpy(session.run(None, feed)[0])
        with torch.no_grad():
            difference = float((found - encoder(*values)).abs().max())
        rows.append({"regions": n_regions, "members": n_members, "difference": difference})
    return rows


def contract(encoder: Any) -> dict[str, Any]:
    """What a caller has to feed, in words."""
    return {
        "inputs": {
            "inputs": f"float32 [regions, members, {encoder.n_inputs}]: flattened descriptor [J, D-1], then the "
            "Gaussian's semantic features where the scene was trained with them; absent if its width is 0",
            "positions": "float32 [regions, members, 3]: (mean - centre) / region radius",
            "mask": "bool [regions, members]: true where a member exists",
        },
        "outputs": {"encodings": f"float32 [regions, {encoder.n_channels}]"},
        "settings": encoder.settings | {"n_inputs": encoder.n_inputs, "n_channels": encoder.n_channels},
    }


main = command("onnx", run)
