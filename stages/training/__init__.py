"""From artifacts and settings to a training."""
