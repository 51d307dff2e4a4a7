"""Settings of the stages: default, range and meaning. Values are part of a key, this code is not.

Those of descriptor and training are in `chebsplat/settings.py`, where the maths reads them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from chebsplat.evaluation import protocols
from chebsplat.formats.names import unprintable
from chebsplat.settings import Section, number, seed, setting

MAX_CHANNELS = 64  # that can be rendered
NAMED_LATER = "teacher.model=MODEL.onnx,train.features=lifted"  # of a finished scene of colours
FETCH = "chebsplat get-teacher segformer-b0-ade"  # which names photographs


def printable(text: str) -> str:
    """The text itself. Raises ValueError if it holds characters that cannot be printed."""
    if unprintable(text):
        raise ValueError(f"{text[:60]!r} holds characters that cannot be printed; leave them out")
    return text


Text = Annotated[str, Field(min_length=1, max_length=4000), AfterValidator(printable)]


class SceneSection(Section):
    name: Text = setting("scene", "what the scene is called; a run gives it")


class SourceSection(Section):
    """Origin of the photos. `named`: Replica's scene if REPLICA_ROOT has it, else generated."""

    kind: Literal[
        "named",
        "generated",
        "colmap",
        "transforms",
        "photos",
        "replica",
        "scannet",
        "seven_scenes",
        "video",
    ] = setting("named", "how the source is read; of a folder it is detected")
    path: Text | None = setting(None, "the source's folder, or its video")
    seed: int = seed("of a generated scene")
    preset: Literal["office", "room", "shuffled", "toy"] = setting(
        "office", "what a generated scene is furnished as"
    )


class IngestSection(Section):
    protocol: Literal[*protocols.NAMES] = setting(  # type: ignore[valid-type]
        "labels", "how the scene is measured: classes, and which views are tested"
    )
    test_every: int | None = number(
        None, "every so many views one is tested; default: the protocol's own", 2, 10_000
    )
    test_offset: int | None = number(
        None, "the first view that is tested; default: the protocol's own", 0, 10_000
    )
    max_side: int = Field(
        default_factory=lambda values: protocols.load(values.get("protocol", "labels")).RULE.side,
        description="pixels; images are reduced to this, never enlarged; default: the protocol's "
        "own",
        ge=16,
        le=8192,
    )
    max_views: int | None = number(
        None, "at most so many views, evenly chosen; default: all", 2, 100_000
    )
    max_train_views: int | None = number(
        None, "at most so many that are trained on, evenly chosen; all test views stay", 2, 100_000
    )
    depth: Literal["auto", "off"] = setting(
        "auto", "that the source brings: taken, or left out as if it brought none"
    )
    classes: dict[Text, list[Text]] | None = setting(
        None,
        "names, each with the source's classes that it stands for; what stands for none is "
        "not counted",
    )
    volumes: Text | None = setting(
        None,
        "JSON of named volumes, which label what depth shows; default: the source's own labels",
    )
    # for studies: errors of real cameras, of known strength, on the training views alone
    disturb_colors: float = number(
        0.0, "exposures at random, in stops; a quarter of it in white balance", 0, 8
    )
    disturb_degrees: float = number(0.0, "turns of the cameras at random", 0, 180)
    disturb_shift: float = number(0.0, "shifts of the cameras at random, in scene units", 0, 1e6)
    min_views: int = number(3, "fewer usable views are an error", 1, 100_000)


class PoseSection(Section):
    """Of photos and videos that come alone."""

    max_side: int = number(1600, "pixels; photos are matched at this, never enlarged", 16, 3200)
    max_views: int | None = number(
        None,
        "at most so many photos or frames, evenly chosen; default: all, of a video 150",
        2,
        100_000,
    )
    camera: Literal[
        "auto", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"
    ] = setting(
        "auto", "model of the lens; auto: what the photos ask for, RADIAL if they are plain"
    )
    peak_threshold: float = number(
        0.0067, "of SIFT; where few photos register, .002 is tried", 1e-6, 1
    )
    max_features: int = number(
        8192, "of a photo: the largest are kept; matching takes their square", 64, 100_000
    )
    matching: Literal["auto", "exhaustive", "sequential"] = setting(
        "auto", "which photos: all, or those next in order and alike; auto: all of up to 100"
    )
    n_matched: int = number(
        10, "most alike photos that each is matched with, where not all are", 2, 1000
    )
    min_registered: float = number(0.5, "fraction of the photos that must register", 1e-3, 1)
    seed: int = seed("of the reconstruction")


class SfmSection(Section):
    max_points: int | None = number(
        None,
        "initial Gaussians, at most; default: 36,000, more above 40 million pixels of photos",
        16,
        2_000_000,
    )
    spacing: Literal["color", "even"] = setting(
        "color",
        "of points of measured depth: closer where colours change, or as far apart everywhere",
    )
    peak_threshold: float = number(
        0.001, "of SIFT: lower finds more features, and worse ones", 1e-6, 1
    )
    max_features: int = number(
        8192, "of a view: the largest are kept; matching takes their square", 64, 100_000
    )
    matching: Literal["auto", "exhaustive", "posed", "sequential"] = setting(
        "auto",
        "which views: all, those with near poses, or those next in order and alike; auto: by poses",
    )
    n_matched: int = number(
        10, "views that each is matched with, where not all are: nearest, or most alike", 2, 1000
    )
    poses: Literal["auto", "given", "adjusted"] = setting(
        "auto",
        "that the source brings: kept, or adjusted to the photos; auto: adjusted where "
        "matches miss them",
    )
    dense: Literal["auto", "on", "off"] = setting(
        "auto",
        "depth of a plane sweep of the photos; auto: where a fifth of their cells hold no point, "
        "and no depth is given",
    )
    enclosure: Literal["auto", "off"] = setting(
        "auto",
        "walls, floor and ceiling continue where no photo looks; auto: with depth, of few photos",
    )
    seed: int = seed("of the choice among points, and of the matches")


class TeacherSection(Section):
    """The 2D teacher. `auto`: the ONNX model if one is named, otherwise the embedded teacher, but
    none for photographs without labels; `embedded`: for these, too; `labels`: the noisy-labels
    teacher; `given`: pseudo labels with a confidence in the source (Panoptic Lifting's ScanNet).
    """

    kind: Literal["auto", "embedded", "labels", "given", "onnx", "none"] = setting(
        "auto", "the 2D teacher; embedded: for photographs, too; none: colour only"
    )
    downscale: int = number(
        4, "pixels of a view that an entry of its map is wide; a coarser model's own", 1, 32
    )
    n_channels: int = number(
        13, "channels of class codes: of labels, and of a closed-set segmenter", 2, MAX_CHANNELS
    )
    # an ONNX model (docs/teachers.md)
    model: Text | None = setting(
        None, ".onnx with a .toml beside it; default: the embedded teacher"
    )
    labels: Text | None = setting(
        None, "text file of labels; default: the capture's classes, else the model's own"
    )
    scales: tuple[Annotated[float, Field(ge=1 / 16, le=8)], ...] = setting(
        (1.0,),
        "of the image as the model sees it; features are averaged",
        min_length=1,
        max_length=16,
        strict=False,
    )
    flips: bool = setting(False, "average with the mirrored image's features")
    # labels
    confusion: float = number(
        0.3, "of the noisy labels: share of segments that bear a wrong one (p)", 0, 1
    )
    blur: float = number(1.0, "of the noisy labels: sigma in feature pixels", 0, 100)
    noise: float = number(
        0.1, "of the noisy labels: standard deviation of the channels' noise", 0, 100
    )
    seed: int = seed("of the noisy labels")


class ChannelsSection(Section):
    """Reduction of a teacher's channels, for all scenes alike.

    Choices: at most 32 channels. The embedded teacher's features span fewer (the number is in
      the artifact's facts) and lose nothing. Of 512 channels like LSeg's 32 keep 99.8 % of the
      decisions between 150 words where the spectrum falls as k^-3 and 95 % where it falls as k^-1;
      13 keep 98 and 77 %. 48 are needed for 1 % relative error in the first case; in the second no
      57 channels, the most that 20 MB a view hold, come below 18 %.
    """

    n_channels: int = number(
        32, "at most; fewer where the teacher's features span fewer", 2, MAX_CHANNELS
    )
    model: Text | None = setting(
        None, ".onnx; a run puts teacher.model here; default: the embedded teacher"
    )
    reference: Text | None = setting(
        None, "folder of images that the channels are fitted to; default: generated rooms"
    )
    n_rooms: int = number(8, "generated rooms that the channels are fitted to", 1, 100)


class AgreeSection(Section):
    """docs/method.md, section 9.

    Choices: of 25 pairs of scene and teacher (make bench=trust), those with an agreement below 0.15
      have a true mIoU of at most 25 %, the others of at least 29 %.
    """

    n_points: int = number(5000, "points that views are compared on, at most", 16, 1_000_000)
    low: float = number(
        0.15, "agreement below which a warning says that the teacher does not know the scene", 0, 1
    )


class LiftSection(Section):
    """docs/method.md, section 12.

    Choices: by agreement with a fifth of the training views that was held out (office0, noisy
      labels, 70 views): 42.8 mIoU for the mean, 43.5 after 5 median steps; gates from 0 to 0.2 are
      alike within 0.1, and more costs.
    """

    gate: float = number(
        0.05, "a pixel belongs to Gaussians of this part of its largest weight; 0: to all", 0, 1
    )


class RefineSection(Section):
    """docs/method.md, section 13."""

    start: Literal["auto", "trained", "lifted", "both"] = setting(
        "auto",
        "features that are refined, both: midway between their directions; auto: both where the "
        "capture has depth, trained where it has not, lifted where none are trained",
    )
    smooth: Literal["auto", "on", "off"] = setting(
        "auto",
        "bilateral smoothing; auto: where half the training views agree better with it "
        "with the other half",
    )

    @property
    def changes_nothing(self) -> bool:
        """True where features stay as the training left them, if there is no knowledge either."""
        return (self.start, self.smooth) == ("trained", "off")


class KnowledgeSection(Section):
    """docs/method.md, section 14."""

    start: Text = setting(
        "rooms",
        "what a scene starts from: none; shipped, to which nothing is added; the name of a set of "
        "lessons in the work folder, which its own joins; or folder/ of a knowledge artifact",
    )


class LearnSection(Section):
    """docs/method.md, section 14."""

    points: Text | None = setting(
        None,
        "a CSV of x, y, z in the scene's frame and a word: only these points teach; "
        "default: what views say",
    )


class TeachSection(Section):
    """The encoder that ships: taught once, over generated rooms."""

    model: Text | None = setting(None, ".onnx of the teacher; default: the embedded one")
    n_rooms: int = number(80, "generated rooms to teach on", 1, 900)
    n_modelled: int = number(
        0,
        "rooms of modelled furniture to teach on beside them: Debian's sweethome3d-furniture",
        0,
        1000,
    )
    n_held_out: int = number(
        8, "rooms that the card's figures are of; eight kinds of room take turns", 1, 100
    )
    n_views: int = number(40, "photos of a room", 2, 1000)
    n_points: int = number(
        14_500, "points of a room, drawn within 0.62 to 1.38 of it", 100, 200_000
    )
    steps: int = number(6000, "of teaching", 1, 1_000_000)
    without: Literal["nothing", "descriptor", "transformer"] = setting(
        "nothing",
        "what the encoder does without, to measure it by: it sees no descriptors; it "
        "pools its neighbours",
    )
    seed: int = seed("of what is drawn in teaching")


class EvaluateSection(Section):
    boundary: int = number(5, "pixels, half width of the boundary band", 1, 100)
    timing_repeats: int = number(
        3, "of every frame; 0: no timing; studies then evaluate in parallel", 0, 1000
    )
    lpips_weights: Text | None = setting(
        None, ".safetensors or .pth with VGG-16 and LPIPS' taps; default: LPIPS is not measured"
    )
