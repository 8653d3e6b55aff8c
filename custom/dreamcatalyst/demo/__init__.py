"""Synthetic scenes, edits of them whose result is known, and the small diffusion model."""
