"""Costs of a training, on a CPU and on a GPU."""
