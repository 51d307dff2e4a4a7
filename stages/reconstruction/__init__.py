"""Cameras and points from photos."""
