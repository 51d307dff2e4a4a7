"""Configuration to keys to a DAG of stages, freshness, and the `chebsplat` command."""
