"""A plan run to its end, here or on a cluster."""
