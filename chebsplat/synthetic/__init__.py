"""Procedural indoor scenes: seeded rooms with furniture, textures, light and a camera path. Arrays only."""

CLASS_NAMES = (
    "wall", "floor", "ceiling", "door", "window", "blinds", "desk", "table", "chair", "sofa", "cabinet", "shelf",
    "monitor", "keyboard", "lamp", "bin", "rug", "plant", "clock", "picture", "book", "cushion",
)  # fmt: skip
