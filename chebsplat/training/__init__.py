"""One training: the model, its losses and schedule, and which Gaussians come and go (Eqs 11-13).

Images are [H, W, 3] in [0, 1], features [h, w, C] at the teacher's resolution, raw parameters as in
`splats`. A share of a training's budget is in [0, 1]. May import evaluation, kernels, rasterize,
settings, shape, splats, views.
"""
