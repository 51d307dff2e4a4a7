"""`deep-blending`: Deep Blending has no labels, so the teacher's are the truth, as in `replica-f3`.

Resolution: as the photos are, 1600 pixels at most, as in 3DGS: drjohnson 1332 wide, playroom 1264.
Split: index % 8 == 0 by name, the rule of 3DGS; Feature 3DGS uses 2, so the offset may be set and
is recorded. PSNR, SSIM and LPIPS (vgg, images in [0, 1] as 3DGS feeds them); frames per second
without the semantic branch. Labels, resizing and averaging: see `replica_f3`.
"""

from __future__ import annotations

from chebsplat.evaluation.protocols.replica_f3 import measure
from chebsplat.evaluation.protocols.task import Rule

RULE = Rule(side=1600, adjustable=True, truth="teacher")

__all__ = ["measure"]
