"""Photos as they come from a camera: how sharp they are, and which frames of a video to take."""
