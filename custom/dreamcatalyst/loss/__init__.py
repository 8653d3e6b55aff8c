"""Losses on images, and anchors of splats."""
