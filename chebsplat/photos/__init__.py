"""Photos as they come from a camera: how sharp they are, which frames of a video to take, the depth
that they tell, the exposures that they were taken with.

Depth is of reduced images, cameras in their pixels. May import cameras and kernels.
"""
