"""Priors: what diffusion models predict, and exact ones in closed form."""
