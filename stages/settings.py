"""Every setting of every stage: default, bounds and meaning. Values are part of an artifact's key; this code is not."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


def setting(default: Any, meaning: str, **bounds: Any) -> Any:
    """A field with what it means in words, for `chebsplat settings`, and its bounds."""
    return Field(default, description=meaning, **bounds)


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneSection(Section):
    name: str = setting("scene", "what the scene is called; a run gives it")


class SourceSection(Section):
    """Where the photos come from. `named` is Replica's scene when REPLICA_ROOT has it, else the generated one."""

    kind: Literal["named", "generated", "colmap", "transforms", "photos", "replica", "scannet", "seven_scenes"] = (
        setting("named", "how the source is read; of a folder it is detected")
    )
    path: str | None = setting(None, "the source's folder")
    seed: int = setting(0, "of a generated scene")
    preset: Literal["office", "room", "toy"] = setting("office", "what a generated scene is furnished as")


class IngestSection(Section):
    protocol: Literal["labels", "replica-f3", "replica-gt", "scannet-open", "scannet-closed", "deep-blending"] = (
        setting("labels", "how the scene is measured: classes, and which views are tested")
    )
    test_every: int | None = setting(None, "every so many views one is tested; default: the protocol's own", ge=2)
    test_offset: int | None = setting(None, "the first view that is tested; default: the protocol's own", ge=0)
    max_side: int = setting(640, "pixels; images are reduced to this, never enlarged", ge=16)
    max_views: int | None = setting(None, "at most so many views, evenly chosen; default: all", ge=2)
    min_views: int = setting(3, "fewer usable views are an error", ge=1)


class SfmSection(Section):
    max_points: int = setting(20_000, "initial Gaussians, at most", ge=16)
    n_neighbors: int = setting(16, "neighbours that give a point its normal and covariance", ge=4)
    peak_threshold: float = setting(0.001, "of SIFT: lower finds more features, and worse ones", gt=0)
    min_registered: float = setting(0.5, "fraction of the views that a reconstruction must register", gt=0, le=1)
    seed: int = setting(0, "of the choice among points, and of the reconstruction")


class TeacherSection(Section):
    """`auto`: the ONNX model if one is given, otherwise the embedded teacher; `labels`: the noisy-labels teacher;
    `given`: pseudo labels with a confidence that the source brings (Panoptic Lifting's ScanNet)."""

    kind: Literal["auto", "labels", "given", "onnx", "none"] = setting("auto", "the 2D teacher; none: colour only")
    downscale: int = setting(4, "pixels of a view that an entry of its map is wide; a coarser model's own", ge=1)
    n_channels: int = setting(13, "channels of class codes: of labels, and of a closed-set segmenter", ge=2)
    # an ONNX model (docs/teachers.md)
    model: str | None = setting(None, ".onnx with a .toml beside it; default: the embedded teacher")
    labels: str | None = setting(None, "text file of labels; default: the capture's classes, else the model's own")
    scales: tuple[Annotated[float, Field(gt=0)], ...] = setting(
        (1.0,), "of the image as the model sees it; features are averaged", min_length=1
    )
    flips: bool = setting(False, "average with the mirrored image's features")
    # labels
    confusion: float = setting(0.3, "of the noisy labels: share of segments that bear a wrong one (p)", ge=0, le=1)
    blur: float = setting(1.0, "of the noisy labels: sigma in feature pixels", ge=0)
    noise: float = setting(0.1, "of the noisy labels: standard deviation of the channels' noise", ge=0)
    seed: int = setting(0, "of the noisy labels")


class ProjectionSection(Section):
    """What a teacher's channels are reduced to, for all scenes alike.

    Choices: at most 32 channels. The embedded teacher's features span fewer (the artifact's facts say how many) and
      lose nothing. Of 512 channels stood in for LSeg's (make bench-store) 32 keep 99.8 % of the decisions between 150
      words where the spectrum falls as k^-3 and 95 % where it falls as k^-1; 13 keep 98 and 77 %. 48 are needed for
      1 % relative error in the first case; in the second no 57 channels, the most that 20 MB a view hold, come below
      18 %.
    """

    n_channels: int = setting(32, "at most; fewer where the teacher's features span fewer", ge=2, le=64)
    model: str | None = setting(None, ".onnx; a run puts teacher.model here; default: the embedded teacher")
    reference: str | None = setting(None, "folder of images that the projection is fitted to; default: generated rooms")
    n_rooms: int = setting(8, "generated rooms that the projection is fitted to", ge=1, le=100)


class DescribeSection(Section):
    """docs/method.md, section 2; shared by the describe stage and the refresh inside training."""

    # with 10 for a, 8 angles are better than 4 and 30 at ghosts and noisy frames (make bench-shapes)
    n_angles: int = setting(8, "rotations of the anisotropic metric (J)", ge=1)
    max_degree: int = setting(8, "degree of the Chebyshev descriptor (D)", ge=2)
    anisotropy: float = setting(10.0, "of the metric (a); 0: isotropic", ge=0)
    bandwidth: float = setting(0.7, "of the edge weights, relative to a region's radius", gt=0)
    spectrum: Literal["full", "taper", "hard"] = setting("full", "eigenvalues that count; hard: the paper's cut")
    n_eigs: int = setting(16, "eigenvalues kept by taper and hard (K)", ge=1)
    region_size: int = setting(32, "Gaussians in a region, at most", ge=4, le=64)
    n_regions: int = setting(768, "regions that cover the scene", ge=1)
    seed: int = setting(0, "of the choice of regions")


class TrainSection(Section):
    steps: int = setting(3000, "of training; the schedule's fractions are of these", ge=1)
    seconds: float | None = setting(None, "of training, instead of steps: the schedule follows the clock", gt=0)
    seed: int = setting(0, "of the order of views and of all that is drawn in training")
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
    grow_threshold: float = setting(1e-4, "gradient to the 2D means that grows a Gaussian, half image widths", gt=0)
    sh_prune: bool = setting(True, "close SH bands that add nothing")
    sh_guided: bool = setting(True, 'false: the paper\'s "no semantic guidance" of SH pruning')
    # sizes
    sh_degree: int = setting(3, "of colour, at most", ge=0, le=3)
    max_gaussians: int = setting(40_000, "growing stops here", ge=16)
    min_gaussians: int = setting(64, "pruning stops here", ge=1)
    width: int = setting(32, "of the encoder's tokens", ge=4, le=1024)
    n_layers: int = setting(2, "of the encoder", ge=1, le=64)
    n_heads: int = setting(4, "of the encoder's attention; divides width", ge=1)
    encode_every: int = setting(4, "steps from one that encodes regions anew to the next", ge=1)
    regions_per_step: int = setting(32, "encoded anew in such a step; the others come from the cache", ge=1)
    n_covers: int = setting(4, "regions that reach a Gaussian, at most", ge=1)
    context: Literal["features", "none"] = setting("features", "what tokens hold beside the descriptor")
    # schedule, as fractions of the budget
    coarse_until: float = setting(0.1, "fraction of the training at half resolution", ge=0, le=1)
    encode_from: float = setting(0.1, "fraction after which regions are encoded", ge=0, le=1)
    densify_from: float = setting(0.1, "fraction after which Gaussians grow", ge=0, le=1)
    densify_until: float = setting(0.6, "fraction after which they no longer do", ge=0, le=1)
    n_densify: int = setting(12, "how often they grow between the two", ge=0)
    prune_from: float = setting(0.4, "fraction after which Gaussians are pruned", ge=0, le=1)
    sh_freeze: float = setting(0.8, "fraction after which SH bands stay as they are", ge=0, le=1)
    refresh_every: int = setting(200, "steps between refreshes of regions and descriptors", ge=1)
    refresh_tolerance: float = setting(0.0, "change, in radii, that leaves a region's descriptors as they are", ge=0)
    report_every: int = setting(100, "steps between rows of the trace", ge=1)
    # rates
    lr_means: float = setting(1.6e-4, "learning rate of centres, relative to the scene's size")
    lr_scales: float = setting(5e-3, "learning rate of log scales")
    lr_quats: float = setting(1e-3, "learning rate of rotations")
    lr_opacities: float = setting(5e-2, "learning rate of opacities before the sigmoid")
    lr_sh0: float = setting(2.5e-3, "learning rate of SH band 0")
    lr_sh: float = setting(1.25e-4, "learning rate of SH bands 1 to 3")
    lr_features: float | None = setting(
        None, "of features; default: 10 / steps, at most 5e-2; more fits each view's errors", gt=0
    )
    lr_encoder: float = setting(3e-3, "learning rate of the encoder")
    lr_masks: float = setting(5e-2, "learning rate of pruning masks")
    lr_sh_masks: float = setting(0.4, "learning rate of SH masks; fast, under a weak penalty: docs/results.md")
    # weights
    weight_ssim: float = setting(0.2, "share of SSIM in the colour loss", ge=0, le=1)
    weight_features: float = setting(1.0, "of the feature loss", ge=0)
    feature_loss: Literal["length", "l1"] = setting("length", "l1: the paper's and Feature-3DGS'")
    weight_shape: float = setting(1.0, "of encodings' distance to their members' features; 0: the printed loss", ge=0)
    weight_mask: float = setting(1e-2, "of the penalty that closes pruning masks", ge=0)
    weight_sh: float = setting(4e-5, "of the penalty that closes SH bands", ge=0)
    weight_basis: float = setting(1.0, "of the pull towards the earlier scenes' knowledge", ge=0)
    warm_start: bool = setting(True, "start the encoder from the basis' stored weights")

    @model_validator(mode="after")
    def _grows_before_bands_close(self) -> TrainSection:
        if self.sh_prune and self.densify != "off" and self.densify_until > self.sh_freeze:
            raise ValueError("densify_until must not lie after sh_freeze, when SH bands are closed for good")
        return self


class ExportSection(Section):
    split_by_degree: bool = setting(True, "write a PLY for each SH degree, too")


class OnnxSection(Section):
    opset: int = setting(18, "of the ONNX files", ge=18)
    tolerance: float = setting(1e-5, "largest difference from torch", gt=0)


class CksSection(Section):
    energy: float = setting(0.96, "share of the energy that the basis grows to hold", gt=0, le=1)
    tolerance: float = setting(0.2, "relative residual below which a scene adds nothing (ε)", gt=0)
    max_rank: float = setting(0.5, "columns, at most, as a fraction of the projection's width", gt=0, lt=1)
    energy_rule: Literal["total", "residual"] = setting(
        "total", "of all a scene holds, or (the printed rule) of what the basis misses"
    )


class EvaluateSection(Section):
    boundary: int = setting(5, "pixels, half width of the boundary band", ge=1)
    timing_repeats: int = setting(3, "of every frame; 0: no timing; studies then evaluate in parallel", ge=0)
    lpips_weights: str | None = setting(
        None, ".safetensors or .pth with VGG-16 and LPIPS' taps; default: LPIPS is not measured"
    )


class ReportSection(Section):
    n_pictures: int = setting(4, "test views in the report", ge=1)
