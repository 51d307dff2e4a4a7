"""Costs of teaching knowledge, and agreement of views."""
