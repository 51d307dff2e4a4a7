"""Basis of compiled kernels: numba's settings and its cache (`jit`), threads that share a kernel's
work (`threads`) and wait for each other (`waiting`), explicit vectors (`simd`).

A vector is 16 float32, of a contiguous array and an index into it as if it were flat. Imports
nothing of chebsplat.
"""
