"""Settings of descriptor and training: default, range and meaning; others: `stages/settings.py`.

Values are part of an artifact's key; this code is not. Upper bounds lie where a machine of 64 GB or
a day of computing ends, far beyond what helps a scene. Types are strict: 1.0 and true are no whole
numbers, and no number is infinite.
"""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

# that a training may grow to by default: from points of measured depth, and from others
FEWEST_GAUSSIANS, FEWEST_GROWN = 40_000, 100_000
FEWEST_STEPS, MOST_STEPS = 1000, 3000  # of a training by default; below, its rates rise no further
PRINTED: dict[str, Any] = {  # train settings that `train.method = "printed"` decides
    "scale_limit": 1000.0,
    "weight_depth": 0.0,
    "feature_every": 1,
    "feature_start": "zero",
    "feature_loss": "l1",
    "densify": "region",
    "sh_freeze": 1.0,
    "sh_degree": 3,
    "exposure": "off",
    "lr_sh_masks": 5e-2,
}
DESCRIPTOR_BYTES = 4 << 30  # of one scene's descriptors, at most


def default_steps(n_pixels: float) -> int:
    """Steps of a training that is not told how many, by the pixels of the training photos.

    Choices: by held-out training views (docs/results/training.md, "How many steps"): the more there
      is to see, the longer a training gains. 70 photos of 320×240 pixels are best served by 1500
      steps, and with 3000 lose 0.5 dB again; 43 of 360×640 gain until 3000.
    """
    return min(max(100 * round(2.8 * n_pixels / 1e6), FEWEST_STEPS), MOST_STEPS)


def default_gaussians(n_pixels: float, measured: bool) -> int:
    """Gaussians, at most, of a scene that is not told how many.

    Args: n_pixels: of the training photos; measured: the initial points come from measured depth.
    Choices: matched points are few, and growth alone fills in texture: fox gains .7 dB by 100,000
      at the same pace, lunddoor 1.2 dB at two thirds of it, plushbed nothing. Rooms with depth,
      which start from 36,000 points, would gain less (office0 .4 dB by 92,000 in the place of
      38,000). Four times the pixels ask for twice as many, since steps do not grow with them
      (docs/results/photographs.md).
    """
    least = FEWEST_GAUSSIANS if measured else FEWEST_GROWN
    return round(least * math.sqrt(max(n_pixels / 40e6, 1)))


def setting(default: Any, meaning: str, **bounds: Any) -> Any:
    """A field with what it means in words, for `chebsplat settings`, and its bounds."""
    return Field(default, description=meaning, **bounds)


def number(default: float | None, meaning: str, low: float, high: float) -> Any:
    """A field from `low` to `high`, both allowed."""
    return setting(default, meaning, ge=low, le=high)


def seed(meaning: str) -> Any:
    """A field for the seed of a random generator."""
    return number(0, meaning, 0, 2**31 - 1)  # what pycolmap takes


class Section(BaseModel):
    """Settings of one kind: frozen, strict about types, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class DescribeSection(Section):
    """docs/method.md, section 2; of the descriptors, and of the regions that training grows by."""

    # with 10 for a, 8 angles are better than 4 and 30 at ghosts and noisy frames
    n_angles: int = number(8, "rotations of the anisotropic metric (J)", 1, 64)
    max_degree: int = number(8, "degree of the Chebyshev descriptor (D)", 2, 64)
    anisotropy: float = number(10.0, "of the metric (a); 0: isotropic", 0, 1e4)
    bandwidth: float = number(0.7, "of the edge weights, relative to a region's radius", 1e-3, 1e3)
    n_eigs: int = number(16, "eigenvalues that the printed method keeps (K)", 1, 64)
    region_size: int = number(32, "Gaussians in a region, at most", 4, 64)
    n_regions: int = number(768, "regions that cover the scene", 1, 200_000)
    overlap: float = number(1.5, "radius of regions over the least that covers the scene", 1, 10)
    seed: int = seed("of the choice of regions")

    @model_validator(mode="after")
    def _fits_in_memory(self) -> DescribeSection:
        size = 4 * self.n_regions * self.region_size * self.n_angles * (self.max_degree + 1)
        if size > DESCRIPTOR_BYTES:
            raise ValueError(
                "n_regions, region_size, n_angles and max_degree make descriptors of "
                f"{size / 2**30:.0f} GB; lower one, {DESCRIPTOR_BYTES >> 30} GB are possible"
            )
        return self


class TrainSection(Section):
    """docs/method.md, sections 3 to 8."""

    steps: int | None = number(
        None,
        "of training; the schedule's fractions are of these; default: 1000 to 3000, by the pixels "
        "of the photos",
        1,
        1_000_000,
    )
    seconds: float | None = number(
        None, "of training, instead of steps: the schedule follows the clock", 0.1, 604_800
    )
    seed: int = seed("of the order of views and of all that is drawn in training")
    start: str | None = setting(
        None, "a 3DGS PLY that training goes on from, instead of the points"
    )
    opacity: float | None = number(
        None,
        "of a point's Gaussian at the start, 3DGS's is 0.1; default: 0.7 where depth is measured, "
        "else 0.3",
        1e-3,
        0.999,
    )
    # what is built
    method: Literal["ours", "printed"] = setting(
        "ours", "printed: the paper's, to the letter (docs/method.md)"
    )
    without: Literal[
        "nothing", "descriptor", "transformer", "pruning guidance", "densification", "SH guidance"
    ] = setting("nothing", "of the printed method: a row of the paper's Table 5")
    region_gradient: Literal["means", "features"] = setting(
        "means",
        "that grows Gaussians in the printed method: of the loss to 2D means, or to fused features",
    )
    semantics: bool = setting(True, "false: colour only")
    features: Literal["trained", "lifted"] = setting(
        "trained",
        "of Gaussians; lifted: colour alone is trained, and the teacher's features are "
        "lifted afterwards",
    )
    feature_start: Literal["lifted", "zero"] | None = setting(
        None,
        "of trained features: what the teacher's views say of the Gaussians at the start, or "
        "nothing; default: lifted from 40 views on",
    )
    prune: bool = setting(True, "remove Gaussians that add nothing")
    densify: Literal["mixed", "region", "classic", "off"] = setting(
        "mixed", "where Gaussians grow; mixed: region and classic by turns"
    )
    grow_threshold: float = number(
        1e-4, "gradient to the 2D means that grows a Gaussian, half image widths", 1e-12, 1e3
    )
    sh_prune: bool = setting(True, "close SH bands that add nothing")
    # photos
    exposure: Literal["auto", "measured", "off"] = setting(
        "auto", "of photos; measured: photos are compared in theirs; auto: where these are large"
    )
    # sizes
    scale_limit: float = number(
        0.33,
        "largest scale of a Gaussian, of its distance to the nearest training camera; 1000: any",
        1e-3,
        1000,
    )
    sh_degree: int = number(3, "of colour, at most", 0, 3)
    max_gaussians: int | None = number(
        None,
        "growing stops here; more initial points are thinned; default: 40,000 of points from "
        "measured depth, 100,000 of others, more above 40 million pixels of photos",
        16,
        5_000_000,
    )
    min_gaussians: int = number(64, "pruning stops here", 1, 5_000_000)
    feature_every: int | None = number(
        None,
        "steps from one that teaches features to the next; default: views / 10, from 1 to 4",
        1,
        1_000_000,
    )
    depth_every: int = number(
        4, "steps from one that places the surface by measured depth to the next", 1, 1_000_000
    )
    # schedule, as fractions of the budget
    coarse_until: float = number(0.1, "fraction of the training at half resolution", 0, 1)
    fine_from: float = number(
        0.6, "fraction after which windows of larger photos are seen at their own resolution", 0, 1
    )
    densify_from: float = number(0.1, "fraction after which Gaussians grow", 0, 1)
    densify_until: float = number(0.6, "fraction after which they no longer do", 0, 1)
    n_densify: int = number(12, "how often they grow between the two", 0, 1000)
    opacity_resets: int = number(
        0, "how often opacities fall to 0.01 while Gaussians grow; 3DGS's schedule: 4", 0, 100
    )
    prune_from: float = number(0.4, "fraction after which Gaussians are pruned", 0, 1)
    remove_every: int = number(
        200, "steps from one pruning to the next, once growth is over", 1, 1_000_000
    )
    sh_freeze: float = number(0.8, "fraction after which SH bands stay as they are", 0, 1)
    refresh_every: int = number(200, "steps between refreshes of regions", 1, 1_000_000)
    report_every: int = number(100, "steps between rows of the trace", 1, 1_000_000)
    # rates
    # 3DGS's are of 30,000 steps; a training of fewer goes further in each, of fewer than 1000 as
    # far as one of 1000
    lr_means: float | None = number(
        None, "of centres, in scene sizes; default: 1.6e-4 (30,000 / steps)^0.61", 0, 10
    )
    lr_scales: float | None = number(
        None, "of log scales; default: 5e-3 (30,000 / steps)^0.52", 0, 10
    )
    lr_quats: float | None = number(
        None, "of rotations; default: 1e-3 (30,000 / steps)^0.52", 0, 10
    )
    lr_sh0: float | None = number(
        None, "of SH band 0; default: 2.5e-3 (30,000 / steps)^0.41", 0, 10
    )
    lr_sh: float | None = number(
        None, "of SH bands 1 to 3; default: 1.25e-4 (30,000 / steps)^0.41", 0, 10
    )
    lr_features: float | None = number(
        None,
        "of features; default: 10 / steps that teach them, at most 5e-2; more fits each "
        "view's errors",
        0,
        10,
    )
    lr_masks: float = number(
        5e-2, "learning rate of pruning masks, in up to 3000 steps; lower in more", 0, 10
    )
    lr_sh_masks: float = number(
        0.4, "learning rate of SH masks; fast, under a weak penalty: docs/results/paper.md", 0, 10
    )
    # weights
    feature_loss: Literal["length", "l1", "cross-entropy"] | None = setting(
        None,
        "l1: the paper's and Feature-3DGS'; cross-entropy: of labels, weighted by confidence; "
        "default: that for labels that a source brings, else length",
    )
    weight_mask: float = number(1e-2, "of the penalty that closes pruning masks", 0, 1e4)
    weight_sh: float = number(4e-5, "of the penalty that closes SH bands", 0, 1e4)
    weight_depth: float | None = number(
        None,
        "of the relative distance to measured depth; default: 0.8 where views agree on it, else 0",
        0,
        1e4,
    )

    @model_validator(mode="after")
    def _fits_together(self) -> TrainSection:
        if self.method == "printed":
            for name, value in PRINTED.items():
                if getattr(self, name) not in (value, type(self).model_fields[name].default):
                    raise ValueError(
                        f"method is printed, which has {name} = {value}; leave {name} out"
                    )
            if self.without == "pruning guidance" and self.region_gradient == "features":
                raise ValueError(
                    "without pruning guidance the colour's gradient decides; leave "
                    "region_gradient out"
                )
            if not (self.semantics and self.features == "trained"):
                raise ValueError(
                    "method is printed, which trains features; leave semantics and features out"
                )
        elif self.without != "nothing" or self.region_gradient != "means":
            raise ValueError(
                "without and region_gradient are of the printed method; set method = printed"
            )
        if (
            self.method == "ours"
            and self.sh_prune
            and self.densify != "off"
            and self.densify_until > self.sh_freeze
        ):
            raise ValueError(
                "densify_until must not lie after sh_freeze, when SH bands are closed for good"
            )
        return self
