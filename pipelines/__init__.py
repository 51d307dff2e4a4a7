"""What runs: configuration to keys to a DAG, freshness, and the `chebsplat` command."""
