"""Every setting of every stage, checked. Values are part of an artifact's key; this module's code is not."""

from __future__ import annotations

import difflib
import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from chebsplat.errors import ConfigError


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneSection(_Section):
    name: str = "scene"


class SourceSection(_Section):
    """Where the photos come from. `named` is Replica's scene when REPLICA_ROOT has it, else the generated one."""

    kind: Literal["named", "generated", "colmap", "transforms", "photos", "replica", "scannet", "seven_scenes"] = (
        "named"
    )
    path: str | None = None
    seed: int = 0  # of a generated scene
    preset: Literal["office", "room", "toy"] = "office"


class IngestSection(_Section):
    protocol: Literal["labels", "replica-f3", "replica-gt", "scannet-open", "scannet-closed", "deep-blending"] = (
        "labels"
    )
    test_every: int | None = Field(None, ge=2)  # None: the protocol's own
    test_offset: int | None = Field(None, ge=0)
    max_side: int = Field(640, ge=16)  # images are reduced to this; never enlarged
    max_views: int | None = Field(None, ge=2)
    min_views: int = Field(3, ge=1)


class SfmSection(_Section):
    max_points: int = Field(20_000, ge=16)
    n_neighbors: int = Field(16, ge=4)
    peak_threshold: float = Field(0.001, gt=0)
    min_registered: float = Field(0.5, gt=0, le=1)  # fraction of views a reconstruction must register
    seed: int = 0


class TeacherSection(_Section):
    """`auto`: the ONNX model if one is given, otherwise the embedded teacher; `labels`: the noisy-labels teacher;
    `given`: pseudo labels with a confidence that the source brings (Panoptic Lifting's ScanNet)."""

    kind: Literal["auto", "labels", "given", "onnx", "none"] = "auto"
    downscale: int = Field(4, ge=1)  # pixels of a view that an entry of its map is wide; a coarser model's own
    n_channels: int = Field(13, ge=2)  # of class codes: of labels, and of a closed-set segmenter
    # an ONNX model (docs/teachers.md)
    model: str | None = None  # .onnx with a .toml beside it
    labels: str | None = None  # text file of the labels to ask for; None: the capture's classes, else the model's own
    scales: tuple[Annotated[float, Field(gt=0)], ...] = Field((1.0,), min_length=1)
    flips: bool = False
    # labels
    confusion: float = Field(0.3, ge=0, le=1)  # p of METHOD.md section 9
    blur: float = Field(1.0, ge=0)  # sigma in feature pixels
    noise: float = Field(0.1, ge=0)
    seed: int = 0


class ProjectionSection(_Section):
    """What a teacher's channels are reduced to, for all scenes alike.

    Choices: at most 32 channels. The embedded teacher's features span fewer (the artifact's facts say how many) and
      lose nothing. Of 512 channels stood in for LSeg's (make bench-store) 32 keep 99.8 % of the decisions between 150
      words where the spectrum falls as k^-3 and 95 % where it falls as k^-1; 13 keep 98 and 77 %. 48 are needed for
      1 % relative error in the first case; in the second no 57 channels, the most that 20 MB a view hold, come below
      18 %.
    """

    n_channels: int = Field(32, ge=2, le=64)  # at most; fewer where the teacher's features span fewer
    model: str | None = None  # .onnx; in a scene the planner puts teacher.model here; None: the embedded teacher
    reference: str | None = None  # folder of images; None: generated rooms
    n_rooms: int = Field(8, ge=1, le=100)


class DescribeSection(_Section):
    """METHOD.md section 2; shared by the describe stage and the refresh inside training."""

    n_angles: int = Field(
        8, ge=1
    )  # J: with 10 for a, better than 4 and 30 at ghosts and noisy frames (make bench-shapes)
    max_degree: int = Field(8, ge=2)  # D
    anisotropy: float = Field(10.0, ge=0)
    bandwidth: float = Field(0.7, gt=0)
    spectrum: Literal["full", "taper", "hard"] = "full"  # hard: the paper's
    n_eigs: int = Field(16, ge=1)  # K, of taper and hard
    region_size: int = Field(32, ge=4, le=64)  # Gaussians in a region, at most
    n_regions: int = Field(768, ge=1)
    seed: int = 0


class TrainSection(_Section):
    steps: int = Field(3000, ge=1)
    seconds: float | None = Field(None, gt=0)  # of training, instead of steps: the schedule follows the clock
    seed: int = 0
    # what is built
    semantics: bool = True
    encoder: Literal["transformer", "mlp", "off"] = "transformer"  # mlp: the paper's "no TLE"
    albo: bool = True  # false: the paper's "no AGCD"
    prune: bool = True
    prune_semantic: bool = True  # false: "no semantic guidance"
    densify: Literal["mixed", "region", "classic", "off"] = "mixed"  # mixed: region and classic by turns
    densify_semantic: bool = True  # false: the rendering loss alone says where
    grow_threshold: float = Field(1e-4, gt=0)  # gradient to the 2D means, half image widths
    sh_prune: bool = True
    sh_guided: bool = True  # false: the paper's "no semantic guidance" of SH pruning
    # sizes
    sh_degree: int = Field(3, ge=0, le=3)
    max_gaussians: int = Field(40_000, ge=16)
    min_gaussians: int = Field(64, ge=1)
    width: int = Field(32, ge=4, le=1024)
    n_layers: int = Field(2, ge=1, le=64)
    n_heads: int = Field(4, ge=1)
    encode_every: int = Field(4, ge=1)  # steps from one that encodes regions anew to the next
    regions_per_step: int = Field(32, ge=1)  # encoded anew in such a step; the others come from the cache
    n_covers: int = Field(4, ge=1)  # regions that reach a Gaussian, at most
    context: Literal["features", "none"] = "features"  # what tokens hold beside the descriptor
    # schedule, as fractions of the budget
    coarse_until: float = Field(0.1, ge=0, le=1)  # half resolution until here
    encode_from: float = Field(0.1, ge=0, le=1)
    densify_from: float = Field(0.1, ge=0, le=1)
    densify_until: float = Field(0.6, ge=0, le=1)
    n_densify: int = Field(12, ge=0)
    prune_from: float = Field(0.4, ge=0, le=1)
    sh_freeze: float = Field(0.8, ge=0, le=1)
    refresh_every: int = Field(200, ge=1)  # steps between refreshes of regions and descriptors
    refresh_tolerance: float = Field(0.0, ge=0)  # change, in radii, that leaves a region's descriptors as they are
    report_every: int = Field(100, ge=1)  # steps between rows of the trace
    # rates
    lr_means: float = 1.6e-4
    lr_scales: float = 5e-3
    lr_quats: float = 1e-3
    lr_opacities: float = 5e-2
    lr_sh0: float = 2.5e-3
    lr_sh: float = 1.25e-4  # of bands 1 to 3
    lr_features: float | None = Field(None, gt=0)  # None: 10 / steps, at most 5e-2; more fits each view's errors
    lr_encoder: float = 3e-3
    lr_masks: float = 5e-2
    lr_sh_masks: float = 0.4  # fast, under a weak penalty: docs/results.md
    # weights
    weight_ssim: float = Field(0.2, ge=0, le=1)
    weight_features: float = Field(1.0, ge=0)
    feature_loss: Literal["length", "l1"] = "length"  # l1: the paper's and Feature-3DGS'
    weight_shape: float = Field(1.0, ge=0)  # of encodings' distance to their members' features; 0: printed
    weight_mask: float = Field(1e-2, ge=0)
    weight_sh: float = Field(4e-5, ge=0)
    weight_basis: float = Field(1.0, ge=0)
    warm_start: bool = True  # start the encoder from the basis' stored weights

    @model_validator(mode="after")
    def _grows_before_bands_close(self) -> TrainSection:
        if self.sh_prune and self.densify != "off" and self.densify_until > self.sh_freeze:
            raise ValueError("densify_until must not lie after sh_freeze, when SH bands are closed for good")
        return self


class ExportSection(_Section):
    split_by_degree: bool = True


class OnnxSection(_Section):
    opset: int = Field(18, ge=18)
    tolerance: float = Field(1e-5, gt=0)


class CksSection(_Section):
    energy: float = Field(0.96, gt=0, le=1)
    tolerance: float = Field(0.2, gt=0)
    max_rank: float = Field(0.5, gt=0, lt=1)  # of the projection's width
    energy_rule: Literal["total", "residual"] = "total"


class EvaluateSection(_Section):
    boundary: int = Field(5, ge=1)  # pixels, half width of the boundary band
    timing_repeats: int = Field(3, ge=0)  # 0: no timing; studies then evaluate in parallel
    lpips_weights: str | None = None  # .safetensors or .pth with VGG-16 and LPIPS' taps; None: not measured


class ReportSection(_Section):
    n_pictures: int = Field(4, ge=1)


class Config(_Section):
    scene: SceneSection = SceneSection()
    source: SourceSection = SourceSection()
    ingest: IngestSection = IngestSection()
    sfm: SfmSection = SfmSection()
    projection: ProjectionSection = ProjectionSection()
    teacher: TeacherSection = TeacherSection()
    describe: DescribeSection = DescribeSection()
    train: TrainSection = TrainSection()
    export: ExportSection = ExportSection()
    onnx: OnnxSection = OnnxSection()
    cks: CksSection = CksSection()
    evaluate: EvaluateSection = EvaluateSection()
    report: ReportSection = ReportSection()

    def sections(self, names: tuple[str, ...]) -> dict[str, Any]:
        """The named sections as plain JSON-able values."""
        return {name: getattr(self, name).model_dump(mode="json") for name in names}


def load(path: Path) -> Config:
    """A config from a TOML or JSON file; sections that are not given keep their defaults."""
    try:
        text = Path(path).read_text()
        values = json.loads(text) if Path(path).suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; pass --config with a TOML file") from None
    except ValueError as error:
        raise ConfigError(f"{path} does not parse: {error}") from None
    return build(values, str(path))


def build(values: dict[str, Any], origin: str) -> Config:
    """A checked config. Raises ConfigError naming the first bad key, with the nearest known name."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{origin}: {where}: {_advice(first)}") from None


def known_keys() -> list[str]:
    return [f"{s}.{k}" for s, f in Config.model_fields.items() for k in f.annotation.model_fields]  # type: ignore[union-attr]


def _advice(error: Any) -> str:
    if error["type"] != "extra_forbidden":
        return f"{error['msg']} (got {error['input']!r})"
    loc = [str(part) for part in error["loc"]]
    if len(loc) == 1:
        near = difflib.get_close_matches(loc[0], list(Config.model_fields), 1)
    else:
        elsewhere = [key for key in known_keys() if key.endswith("." + loc[-1])]
        own = [key.split(".")[1] for key in known_keys() if key.startswith(loc[0] + ".")]
        near = elsewhere or [f"{loc[0]}.{key}" for key in difflib.get_close_matches(loc[-1], own, 1)]
    return "no such key" + (f"; did you mean {near[0]}?" if near else "")
