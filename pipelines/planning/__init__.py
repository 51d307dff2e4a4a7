"""Which steps a scene needs, and under which keys."""
