"""What every stage runs in: its command, settings, device, progress and signals."""
