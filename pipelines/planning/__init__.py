"""The steps that a scene needs, and their keys."""
