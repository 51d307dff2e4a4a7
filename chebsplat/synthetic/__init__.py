"""Procedural indoor scenes: layout, meshes, textures, shading, camera paths."""
