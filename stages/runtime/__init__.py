"""The runtime of all stages: command, settings, device, progress and signals."""
