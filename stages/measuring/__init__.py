"""Figures of a finished scene."""
