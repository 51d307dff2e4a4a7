"""Training: from artifacts and settings to a trainer, its steps, saves and facts."""
