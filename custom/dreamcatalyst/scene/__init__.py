"""Gaussian splats: parameters, PLY files, and surgery on both them and their optimizer state."""
