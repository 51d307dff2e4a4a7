"""Photos from a camera: their sharpness, the frames to take of a video, depth, and exposures.

Depth is of reduced images, cameras in their pixels. May import cameras and kernels.
"""
