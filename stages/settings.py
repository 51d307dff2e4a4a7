"""Every setting of every stage: default, range and meaning. Values are part of an artifact's key; this code is not.

Upper bounds lie where a machine of 64 GB or a day of computing ends, far beyond what helps a scene. Types are strict:
1.0 and true are no whole numbers, and no number is infinite.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from chebsplat.formats.names import unprintable
from chebsplat.stages.label_space import MAX_CHANNELS

DESCRIPTOR_BYTES = 4 << 30  # of one scene's descriptors, at most


def setting(default: Any, meaning: str, **bounds: Any) -> Any:
    """A field with what it means in words, for `chebsplat settings`, and its bounds."""
    return Field(default, description=meaning, **bounds)


def number(default: float | None, meaning: str, low: float, high: float) -> Any:
    """A field from `low` to `high`, both allowed."""
    return setting(default, meaning, ge=low, le=high)


def seed(meaning: str) -> Any:
    return number(0, meaning, 0, 2**31 - 1)  # what pycolmap takes


def printable(text: str) -> str:
    if unprintable(text):
        raise ValueError(f"{text[:60]!r} holds characters that cannot be printed")
    return text


Text = Annotated[str, Field(min_length=1, max_length=4000), AfterValidator(printable)]


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class SceneSection(Section):
    name: Text = setting("scene", "what the scene is called; a run gives it")


class SourceSection(Section):
    """Where the photos come from. `named` is Replica's scene when REPLICA_ROOT has it, else the generated one."""

    kind: Literal["named", "generated", "colmap", "transforms", "photos", "replica", "scannet", "seven_scenes"] = (
        setting("named", "how the source is read; of a folder it is detected")
    )
    path: Text | None = setting(None, "the source's folder")
    seed: int = seed("of a generated scene")
    preset: Literal["office", "room", "toy"] = setting("office", "what a generated scene is furnished as")


class IngestSection(Section):
    protocol: Literal["labels", "replica-f3", "replica-gt", "scannet-open", "scannet-closed", "deep-blending"] = (
        setting("labels", "how the scene is measured: classes, and which views are tested")
    )
    test_every: int | None = number(None, "every so many views one is tested; default: the protocol's own", 2, 10_000)
    test_offset: int | None = number(None, "the first view that is tested; default: the protocol's own", 0, 10_000)
    max_side: int = number(640, "pixels; images are reduced to this, never enlarged", 16, 8192)
    max_views: int | None = number(None, "at most so many views, evenly chosen; default: all", 2, 100_000)
    min_views: int = number(3, "fewer usable views are an error", 1, 100_000)


class SfmSection(Section):
    max_points: int = number(20_000, "initial Gaussians, at most", 16, 2_000_000)
    n_neighbors: int = number(16, "neighbours that give a point its normal and covariance", 4, 64)
    peak_threshold: float = number(0.001, "of SIFT: lower finds more features, and worse ones", 1e-6, 1)
    min_registered: float = number(0.5, "fraction of the views that a reconstruction must register", 1e-3, 1)
    seed: int = seed("of the choice among points, and of the reconstruction")


class TeacherSection(Section):
    """`auto`: the ONNX model if one is given, otherwise the embedded teacher; `labels`: the noisy-labels teacher;
    `given`: pseudo labels with a confidence that the source brings (Panoptic Lifting's ScanNet)."""

    kind: Literal["auto", "labels", "given", "onnx", "none"] = setting("auto", "the 2D teacher; none: colour only")
    downscale: int = number(4, "pixels of a view that an entry of its map is wide; a coarser model's own", 1, 32)
    n_channels: int = number(13, "channels of class codes: of labels, and of a closed-set segmenter", 2, MAX_CHANNELS)
    # an ONNX model (docs/teachers.md)
    model: Text | None = setting(None, ".onnx with a .toml beside it; default: the embedded teacher")
    labels: Text | None = setting(None, "text file of labels; default: the capture's classes, else the model's own")
    scales: tuple[Annotated[float, Field(ge=1 / 16, le=8)], ...] = setting(
        (1.0,), "of the image as the model sees it; features are averaged", min_length=1, max_length=16, strict=False
    )
    flips: bool = setting(False, "average with the mirrored image's features")
    # labels
    confusion: float = number(0.3, "of the noisy labels: share of segments that bear a wrong one (p)", 0, 1)
    blur: float = number(1.0, "of the noisy labels: sigma in feature pixels", 0, 100)
    noise: float = number(0.1, "of the noisy labels: standard deviation of the channels' noise", 0, 100)
    seed: int = seed("of the noisy labels")


class ProjectionSection(Section):
    """What a teacher's channels are reduced to, for all scenes alike.

    Choices: at most 32 channels. The embedded teacher's features span fewer (the artifact's facts say how many) and
      lose nothing. Of 512 channels stood in for LSeg's (make bench-store) 32 keep 99.8 % of the decisions between 150
      words where the spectrum falls as k^-3 and 95 % where it falls as k^-1; 13 keep 98 and 77 %. 48 are needed for
      1 % relative error in the first case; in the second no 57 channels, the most that 20 MB a view hold, come below
      18 %.
    """

    n_channels: int = number(32, "at most; fewer where the teacher's features span fewer", 2, MAX_CHANNELS)
    model: Text | None = setting(None, ".onnx; a run puts teacher.model here; default: the embedded teacher")
    reference: Text | None = setting(
        None, "folder of images that the projection is fitted to; default: generated rooms"
    )
    n_rooms: int = number(8, "generated rooms that the projection is fitted to", 1, 100)


class DescribeSection(Section):
    """docs/method.md, section 2; shared by the describe stage and the refresh inside training."""

    # with 10 for a, 8 angles are better than 4 and 30 at ghosts and noisy frames (make bench-shapes)
    n_angles: int = number(8, "rotations of the anisotropic metric (J)", 1, 64)
    max_degree: int = number(8, "degree of the Chebyshev descriptor (D)", 2, 64)
    anisotropy: float = number(10.0, "of the metric (a); 0: isotropic", 0, 1e4)
    bandwidth: float = number(0.7, "of the edge weights, relative to a region's radius", 1e-3, 1e3)
    spectrum: Literal["full", "taper", "hard"] = setting("full", "eigenvalues that count; hard: the paper's cut")
    n_eigs: int = number(16, "eigenvalues kept by taper and hard (K)", 1, 64)
    region_size: int = number(32, "Gaussians in a region, at most", 4, 64)
    n_regions: int = number(768, "regions that cover the scene", 1, 200_000)
    seed: int = seed("of the choice of regions")

    @model_validator(mode="after")
    def _fits_in_memory(self) -> DescribeSection:
        size = 4 * self.n_regions * self.region_size * self.n_angles * (self.max_degree + 1)
        if size > DESCRIPTOR_BYTES:
            raise ValueError(
                f"n_regions, region_size, n_angles and max_degree make descriptors of {size / 2**30:.0f} GB; "
                f"lower one, {DESCRIPTOR_BYTES >> 30} GB are possible"
            )
        return self


class TrainSection(Section):
    steps: int = number(3000, "of training; the schedule's fractions are of these", 1, 1_000_000)
    seconds: float | None = number(None, "of training, instead of steps: the schedule follows the clock", 0.1, 604_800)
    seed: int = seed("of the order of views and of all that is drawn in training")
    # what is built
    semantics: bool = setting(True, "false: colour only")
    encoder: Literal["transformer", "mlp", "off"] = setting(
        "transformer", 'of regions; mlp: the paper\'s "no TLE"; off: no shape branch'
    )
    albo: bool = setting(True, 'tokens hold descriptors; false: the paper\'s "no AGCD"')
    prune: bool = setting(True, "remove Gaussians that add nothing")
    prune_semantic: bool = setting(True, 'features guard Gaussians from pruning; false: "no semantic guidance"')
    densify: Literal["mixed", "region", "classic", "off"] = setting(
        "mixed", "where Gaussians grow; mixed: region and classic by turns"
    )
    densify_semantic: bool = setting(True, "false: the rendering loss alone says where Gaussians grow")
    grow_threshold: float = number(
        1e-4, "gradient to the 2D means that grows a Gaussian, half image widths", 1e-12, 1e3
    )
    sh_prune: bool = setting(True, "close SH bands that add nothing")
    sh_guided: bool = setting(True, 'false: the paper\'s "no semantic guidance" of SH pruning')
    # sizes
    sh_degree: int = number(3, "of colour, at most", 0, 3)
    max_gaussians: int = number(40_000, "growing stops here; more initial points are thinned", 16, 5_000_000)
    min_gaussians: int = number(64, "pruning stops here", 1, 5_000_000)
    width: int = number(32, "of the encoder's tokens", 4, 1024)
    n_layers: int = number(2, "of the encoder", 1, 64)
    n_heads: int = number(4, "of the encoder's attention; divides width", 1, 64)
    encode_every: int = number(4, "steps from one that encodes regions anew to the next", 1, 1_000_000)
    regions_per_step: int = number(32, "encoded anew in such a step; the others come from the cache", 1, 4096)
    n_covers: int = number(4, "regions that reach a Gaussian, at most", 1, 64)
    context: Literal["features", "none"] = setting("features", "what tokens hold beside the descriptor")
    # schedule, as fractions of the budget
    coarse_until: float = number(0.1, "fraction of the training at half resolution", 0, 1)
    encode_from: float = number(0.1, "fraction after which regions are encoded", 0, 1)
    densify_from: float = number(0.1, "fraction after which Gaussians grow", 0, 1)
    densify_until: float = number(0.6, "fraction after which they no longer do", 0, 1)
    n_densify: int = number(12, "how often they grow between the two", 0, 1000)
    prune_from: float = number(0.4, "fraction after which Gaussians are pruned", 0, 1)
    sh_freeze: float = number(0.8, "fraction after which SH bands stay as they are", 0, 1)
    refresh_every: int = number(200, "steps between refreshes of regions and descriptors", 1, 1_000_000)
    refresh_tolerance: float = number(0.0, "change, in radii, that leaves a region's descriptors as they are", 0, 1e3)
    report_every: int = number(100, "steps between rows of the trace", 1, 1_000_000)
    # rates
    lr_means: float = number(1.6e-4, "learning rate of centres, relative to the scene's size", 0, 10)
    lr_scales: float = number(5e-3, "learning rate of log scales", 0, 10)
    lr_quats: float = number(1e-3, "learning rate of rotations", 0, 10)
    lr_opacities: float = number(5e-2, "learning rate of opacities before the sigmoid", 0, 10)
    lr_sh0: float = number(2.5e-3, "learning rate of SH band 0", 0, 10)
    lr_sh: float = number(1.25e-4, "learning rate of SH bands 1 to 3", 0, 10)
    lr_features: float | None = number(
        None, "of features; default: 10 / steps, at most 5e-2; more fits each view's errors", 0, 10
    )
    lr_encoder: float = number(3e-3, "learning rate of the encoder", 0, 10)
    lr_masks: float = number(5e-2, "learning rate of pruning masks", 0, 10)
    lr_sh_masks: float = number(0.4, "learning rate of SH masks; fast, under a weak penalty: docs/results.md", 0, 10)
    # weights
    weight_ssim: float = number(0.2, "share of SSIM in the colour loss", 0, 1)
    weight_features: float = number(1.0, "of the feature loss", 0, 1e4)
    feature_loss: Literal["length", "l1"] = setting("length", "l1: the paper's and Feature-3DGS'")
    weight_shape: float = number(1.0, "of encodings' distance to their members' features; 0: the printed loss", 0, 1e4)
    weight_mask: float = number(1e-2, "of the penalty that closes pruning masks", 0, 1e4)
    weight_sh: float = number(4e-5, "of the penalty that closes SH bands", 0, 1e4)
    weight_basis: float = number(1.0, "of the pull towards the earlier scenes' knowledge", 0, 1e4)
    warm_start: bool = setting(True, "start the encoder from the basis' stored weights")

    @model_validator(mode="after")
    def _fits_together(self) -> TrainSection:
        if self.sh_prune and self.densify != "off" and self.densify_until > self.sh_freeze:
            raise ValueError("densify_until must not lie after sh_freeze, when SH bands are closed for good")
        if self.encoder == "transformer" and self.width % self.n_heads:
            raise ValueError(f"width {self.width} must be a multiple of n_heads {self.n_heads}")
        return self


class ExportSection(Section):
    split_by_degree: bool = setting(True, "write a PLY for each SH degree, too")


class OnnxSection(Section):
    opset: int = number(18, "of the ONNX files", 18, 25)
    tolerance: float = number(1e-5, "largest difference from torch", 1e-12, 1)


class CksSection(Section):
    energy: float = number(0.96, "share of the energy that the basis grows to hold", 1e-3, 1)
    tolerance: float = number(0.2, "relative residual below which a scene adds nothing (ε)", 1e-6, 10)
    max_rank: float = number(0.5, "columns, at most, as a fraction of the projection's width", 1e-3, 0.999)
    energy_rule: Literal["total", "residual"] = setting(
        "total", "of all a scene holds, or (the printed rule) of what the basis misses"
    )


class EvaluateSection(Section):
    boundary: int = number(5, "pixels, half width of the boundary band", 1, 100)
    timing_repeats: int = number(3, "of every frame; 0: no timing; studies then evaluate in parallel", 0, 1000)
    lpips_weights: Text | None = setting(
        None, ".safetensors or .pth with VGG-16 and LPIPS' taps; default: LPIPS is not measured"
    )


class ReportSection(Section):
    n_pictures: int = number(4, "test views in the report", 1, 100)
