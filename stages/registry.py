"""Table of the stages, their inputs and cost, for the commands, the planner and the Snakefile."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MANY = "lesson"  # the role of which a stage may read many
LESSON = f"{MANY}-"  # begins the roles of lessons, each followed by its key
OF_KNOWLEDGE = ("describe", "encode", "learn", "recall", "onnx")
MODEL_FREE = ("labels", "given", "none")  # kinds of teacher that run no model


def lesson_paths(paths: Mapping[str, Path]) -> dict[str, Path]:
    """Inputs of the stage `recall` from lessons by key."""
    return {LESSON + key: path for key, path in paths.items()}


@dataclass(frozen=True)
class Stage:
    """One stage. `inputs` map a role (`--in-<role>`) to the stage that makes it.

    seconds, megabytes: what it takes on two idle cores of an AMD EPYC and what it writes, by the
      facts of a scene (`pipelines.planning.forecast.SceneFacts`): fitted to generated rooms, fox,
      redkitchen, house_kitchen and seven captures of photos at 640 to 1600 pixels, within a factor
      of 1.5 for most. A machine corrects the seconds by those of its own scenes.
    memory: MB that its process has at most on a CPU, by the same facts: fitted to office0, fox,
      redkitchen, house_kitchen, and 23 to 100 photos of 1600 pixels. A user's teacher and
      more than 40,000 Gaussians were not measured.
    minutes, mem_mb: what a job requests of a cluster, ten times the longest measured time and three
      times the memory: a job that requests too little is lost, one that requests too much starts a
      little later; the memory is doubled at each retry. Measured in 18 scenes on two EPYC cores:
      seconds (median, max); peak memory in office0.
    """

    name: str
    schema: str
    sections: tuple[str, ...]  # the parts of the config it reads, and nothing else
    inputs: tuple[tuple[str, str], ...] = ()
    optional: tuple[tuple[str, str], ...] = ()
    help: str = ""

    of_scene: bool = True  # false: never a part of a scene's run, only an input of one
    # stages of the scene that come first, although nothing of theirs is read
    after: tuple[str, ...] = ()
    # runs on a GPU where one is used, to other bytes than the CPU's: the device is in the key then
    on_device: bool = False
    device_packages: tuple[str, ...] = ()  # that it uses there
    of_protocol: bool = False  # runs the module of `ingest.protocol`, which is in the key then
    seconds: Callable[[Any], float] = lambda _: 1.0
    megabytes: Callable[[Any], float] = lambda _: 0.0
    memory: Callable[[Any], float] = lambda _: 700.0
    minutes: int = 5
    mem_mb: int = 4000

    def schemas(self, roles: Iterable[str]) -> dict[str, str]:
        """Schema of the input of each role; `lesson-KEY`, one of many, has that of `lesson`.

        Raises: KeyError on a role that the stage has not.
        """
        return {role: STAGES[self.roles[role.partition("-")[0]]].schema for role in roles}

    def device(self, requested: str, sections: Mapping[str, Any]) -> str:
        """The device it runs on: `requested`, or the CPU where its settings need no GPU."""
        idle = self.name == "teacher" and sections["teacher"]["kind"] in MODEL_FREE
        # plain torch and SciPy
        idle = idle or (self.name == "train" and sections["train"]["method"] == "printed")
        return requested if self.on_device and not idle else "cpu"

    @property
    def roles(self) -> dict[str, str]:
        return dict(self.inputs + self.optional)


STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage("pose", "chebsplat.model/1", ("source", "pose"),
              seconds=lambda k: 2 + 0.06 * k.raw + 0.6 * k.posed
              + (0.3 * k.photos + 0.04 * k.pairs) * k.rich,
              megabytes=lambda k: 0.5, minutes=100,
              help="Cameras and poses of photos or a video that come alone."),
        Stage("ingest", "chebsplat.capture/2", ("scene", "source", "ingest"),
              optional=(("model", "pose"),), of_protocol=True,
              seconds=lambda k: 0.5 + 2.4 * k.trained if k.kind == "generated"
              else 0.5 + 0.03 * k.raw + 0.4 * k.trained,
              megabytes=lambda k: 2.7 * k.trained, minutes=10, mem_mb=2000,  # 21, 49; 306 MB
              # a photo that is reduced takes more than one that is undistorted alone
              memory=lambda k: 350 + 3.6 * k.trained
              + (970 if k.raw > 1.01 * k.trained else 560) * k.trained / k.photos,
              help="Read a source into a capture: images, cameras and, where given, depth and "
                   "labels."),
        Stage("sfm", "chebsplat.points/2", ("sfm",), (("capture", "ingest"),),
              # transforms bring no points, and poses that a depth camera tracks are adjusted
              # most photos that come alone are swept, each reduced to the same few pixels
              seconds=lambda k: 0.5 + 0.1 * k.trained + 0.25 * k.photos
              if k.kind in ("photos", "video")
              else 0.5 + {"transforms": 1.0, "seven_scenes": 2.6}.get(k.kind, 0.3) * k.trained,
              megabytes=lambda k: 2.3, minutes=100,  # 5 with depth; 295 MB
              memory=lambda k: 650 + 4.4 * k.trained,
              help="Cameras and points with normals and local anisotropic covariances."),
        Stage("channels", "chebsplat.channels/2", ("channels",),
              seconds=lambda k: 0.1, minutes=10, mem_mb=2000,  # 18, 48
              help="From a teacher's channels to the fewer that all scenes are trained in."),
        Stage("teacher", "chebsplat.features/2", ("teacher",), (("capture", "ingest"),),
              (("channels", "channels"),), on_device=True,
              seconds=lambda k: 1.5 + 0.45 * k.trained if k.model else 0.5 + 0.1 * k.trained,
              megabytes=lambda k: (3 if k.model else 1) * k.trained,
              memory=lambda k: 1100, minutes=15,  # 9, 66
              help="Per-view semantic features of a 2D teacher."),
        Stage("agree", "chebsplat.agreement/2", ("agree",),
              (("capture", "ingest"), ("points", "sfm"), ("features", "teacher")),
              seconds=lambda k: 0.6, mem_mb=2000,  # 1, 3; 121 MB
              help="How far views agree on what the same points are: whether the teacher knows "
                   "the scene."),
        Stage("teach", "chebsplat.knowledge/4", ("teach",), (("channels", "channels"),),
              of_scene=False, minutes=600, mem_mb=8000,  # 3142
              help="The encoder of shape that scenes start from, taught over generated rooms."),
        Stage("describe", "chebsplat.descriptors/2", ("describe",),
              (("capture", "ingest"), ("points", "sfm")),
              seconds=lambda k: 3.0, megabytes=lambda k: 19, memory=lambda k: 1050,
              help="Anisotropic Chebyshev descriptors of the surface's points at four radii "
                   "(Eqs 1-6)."),
        Stage("encode", "chebsplat.encoding/1", (),
              (("descriptors", "describe"), ("start", "teach")),
              seconds=lambda k: 1.6, megabytes=lambda k: 24,
              help="Features of the shape about each point, by the knowledge's transformers "
                   "(Eq 7)."),
        Stage("learn", "chebsplat.lesson/2", ("scene", "learn"),
              (("capture", "ingest"), ("points", "sfm"), ("descriptors", "describe"),
               ("encoding", "encode"), ("features", "teacher"), ("start", "teach")),
              seconds=lambda k: 0.8,
              help="What the scene teaches about shape, for the scenes after it."),
        Stage("recall", "chebsplat.knowledge/4", (), (("start", "teach"),), (("lesson", "learn"),),
              seconds=lambda k: 0.5,
              help="What the scene starts from: what ships, and the lessons that it is pinned to "
                   "(Eqs 14-15)."),
        Stage("onnx", "chebsplat.encoder/4", (),
              (("knowledge", "recall"), ("descriptors", "describe")),
              seconds=lambda k: 0.6,
              help="The encoder of shape and the scene's knowledge as one ONNX graph, compared "
                   "with torch."),
        Stage("train", "chebsplat.gaussians/2", ("describe", "train"),
              (("capture", "ingest"), ("points", "sfm")),
              (("features", "teacher"), ("earlier", "train")), after=("agree",), on_device=True,
              device_packages=("gsplat",),
              seconds=lambda k: k.clock or 3 + k.step * k.steps,
              megabytes=lambda k: (14 if k.semantic else 8) * k.gaussians / 40_000,
              memory=lambda k: 520 + 5 * k.trained + 100 * k.semantic + 80 * k.gaussians / 40_000,
              minutes=15,  # plus the time of its steps: 80, 239 for 3000; 693 MB
              help="Train the semantic Gaussian scene (Eqs 11-13)."),
        Stage("lift", "chebsplat.lifted/2", ("lift",),
              (("capture", "ingest"), ("gaussians", "train"), ("features", "teacher")),
              seconds=lambda k: 0.7 + 0.02 * k.trained,
              megabytes=lambda k: 10 * k.gaussians / 40_000, mem_mb=2000,  # 5, 12; 571 MB
              help="Features of the teacher on trained Gaussians, and how much the views agree, "
                   "without training."),
        Stage("refine", "chebsplat.refined/2", ("refine",),
              (("gaussians", "train"), ("lifted", "lift")),
              (("capture", "ingest"), ("descriptors", "describe"), ("encoding", "encode"),
               ("features", "teacher"), ("knowledge", "recall")),
              megabytes=lambda k: 4 * k.gaussians / 40_000, memory=lambda k: 1100,  # 9, 22
              help="Blend the features of a finished scene with knowledge, and smooth them, as its "
                   "training views ask."),
        Stage("export", "chebsplat.scene/5", (), (("gaussians", "train"),),
              (("features", "teacher"), ("lifted", "lift"), ("refined", "refine")),
              seconds=lambda k: 0.1, megabytes=lambda k: 18 * k.gaussians / 40_000,
              mem_mb=2000,  # 1, 2; 138 MB
              help="Write PLY and SPZ, ragged zarr, the label dictionary and the summary."),
        Stage("evaluate", "chebsplat.evaluation/2", ("evaluate",),
              (("capture", "ingest"), ("scene", "export")),
              (("features", "teacher"),), on_device=True, device_packages=("gsplat",),
              of_protocol=True, seconds=lambda k: 1 + 0.2 * k.trained,
              megabytes=lambda k: 0.5 * k.trained, mem_mb=2000,  # 5, 27; 646 MB
              memory=lambda k: 530 + 1.2 * k.trained + 580 * k.compared,
              help="Measure the exported scene on the test views."),
        Stage("report", "chebsplat.report/1", (),
              (("evaluation", "evaluate"), ("gaussians", "train")),
              (("model", "pose"), ("capture", "ingest"), ("points", "sfm"),
               ("channels", "channels"), ("features", "teacher"), ("agreement", "agree"),
               ("descriptors", "describe"), ("encoding", "encode"), ("learned", "learn"),
               ("knowledge", "recall"), ("encoder", "onnx"), ("lifted", "lift"),
               ("refined", "refine"), ("scene", "export")),
              seconds=lambda k: 0.8, megabytes=lambda k: 2, mem_mb=2000,  # 2, 7; 144 MB
              help="One self-contained HTML page with pictures, tables and error against "
                   "run time."),
    )
}  # fmt: skip
