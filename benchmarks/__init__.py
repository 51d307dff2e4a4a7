"""Benchmarks: speed and accuracy beside their bars, on the machine at hand; `python -m benchmarks`
lists them.

Tables, CSV files and figures go to build/bench. Each module ends with `main(arguments)`, which
returns the exit code.
"""

# before torch: a busy machine punishes OpenMP threads that wait actively
import chebsplat  # noqa: F401
