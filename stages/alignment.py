"""Test views at poses that are refined by their own photos against a finished scene, for figures of their own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from chebsplat.stages.command import Job

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.render import SceneRenderer
    from chebsplat.views import View

STEPS, RATE = 40, 0.5  # of Adam a view; pixels, in the first step


def aligned_renders(
    job: Job, renderer: SceneRenderer, cameras: list[View], truth: np.ndarray, masks: list[np.ndarray] | None
) -> np.ndarray:
    """Renders u8 [V, H, W, 3] of views whose poses follow the photometric loss while the Gaussians stay as they are.

    Args: truth u8 [V, H, W, 3]; masks [H, W] bool a view, true where a pixel counts, or None.
    Choices: colours stay those of the given pose, from which they differ by less than a photo's noise. These figures
      see the test photos, so that they never stand in place of those at the given poses.
    """
    import numpy as np
    import torch

    from chebsplat.rasterize import rasterize
    from chebsplat.training.losses import photometric
    from chebsplat.training.poses import Poses, moved
    from chebsplat.views import in_frustum

    renders, device, points = [], renderer.means.device, renderer.means.cpu()
    for k, _ in job.progress.track(range(len(cameras)), len(cameras), "align"):
        view, photo = cameras[k].to(device), torch.from_numpy(truth[k]).to(device).float() / 255
        mask = None if masks is None else torch.from_numpy(np.asarray(masks[k])).to(device)
        given, size = (cameras[k].viewmat[None], cameras[k].K[None]), (view.width, view.height)
        poses = Poses(*given, size, points, RATE, free=True, device=device)
        index = in_frustum(renderer.means, view, renderer.reach)
        parts = renderer.scales[index], renderer.opacities[index], renderer.colors(view, index)
        for step in range(STEPS):
            camera = poses.camera(view, 0)
            means, quats = moved(renderer.means[index], renderer.quats[index], camera)
            frame = camera.viewmat[None], camera.K[None], camera.width, camera.height
            image = rasterize(means, quats, *parts, *frame)[0][0]
            photometric(image, photo, mask, 0.2).backward()
            poses.step(0, step / STEPS)
        renders.append(renderer.render(poses.camera(view, 0, learning=False))[0])
    return np.stack(renders)
