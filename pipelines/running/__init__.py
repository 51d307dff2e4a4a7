"""Plans executed by Snakemake, on this machine or on a cluster."""
