"""What compiled kernels are made of: numba's settings and its cache (`jit`), and explicit vectors (`simd`)."""
