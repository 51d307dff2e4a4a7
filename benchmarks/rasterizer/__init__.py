"""The CPU rasterizer: its stages and whole steps timed, its images and gradients against float64."""
