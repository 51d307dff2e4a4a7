"""lift: the 2D teacher's features on trained Gaussians, by one pass over the training views."""

from __future__ import annotations

from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.lifting.blend import labels_agree
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.training.lifting import lifted_from
from chebsplat.stages.training.truth import labels_right


def run(job: Job) -> None:
    """Lift features to Gaussians, with their evidence, untrained (docs/method.md, section 12).

    Reads `capture`, `gaussians` and `features`. Writes `lifted`.
    """
    capture = Capture.read(job.inputs["capture"])
    gaussians = Gaussians.read(job.inputs["gaussians"])
    features = Features.read(job.inputs["features"])
    lifted = lifted_from(
        capture,
        gaussians.cameras,
        gaussians.parameters,
        features,
        job.config.lift.gate,
        job.progress,
    )
    n = len(lifted.features)
    job.facts |= {
        "n_gaussians": n,
        "n_unseen": int((lifted.n_views == 0).sum()),
        "n_observations": lifted.notes["n_observations"],
        "n_views": len(lifted.notes["views"]),
        "labels_agree": labels_agree(lifted.halves, lifted.half_views, features.label_embeddings),
        "right": labels_right(capture, gaussians.parameters, lifted.features, features),
    }
    lifted.write(job.out)
