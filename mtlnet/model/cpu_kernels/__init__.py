"""Kernels that make training of `mtl`, `grid` and `grid_residual` faster on a CPU."""
