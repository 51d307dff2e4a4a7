"""Photos as they come from a camera: how sharp they are, which frames of a video to take, the depth that they tell.

Images are reduced ones, cameras in their pixels. May import kernels.
"""
