"""What long use does to a machine: runs killed at random moments, full disks, hundreds of runs one
after another.

`make soak` does each in full and writes build/soak-*.csv; `make test` does each once. Everything is
seeded, bounded, and uses one tiny scene.
"""
