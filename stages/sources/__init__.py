"""Sources of a capture: one module for each kind."""
