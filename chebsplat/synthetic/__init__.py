"""Procedural indoor scenes: seeded rooms with furniture, textures, light and a camera path.

Metres, z up, the floor at z = 0; colours are linear, in [0, 1]; triangles are [T, 3] into vertices
[V, 3]. Arrays only; imports of chebsplat the centres of cameras and the errors alone.
"""

CLASS_NAMES = (
    "wall", "floor", "ceiling", "door", "window", "blinds", "desk", "table", "chair", "sofa",
    "cabinet", "shelf", "monitor", "keyboard", "lamp", "bin", "rug", "plant", "clock", "picture",
    "book", "cushion",
)  # fmt: skip
