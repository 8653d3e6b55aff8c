"""The compiled CPU rasterizer: numba kernels of each phase, and the differentiable nodes around them (`api`)."""
