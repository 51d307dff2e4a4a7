"""Costs of using a finished scene."""
