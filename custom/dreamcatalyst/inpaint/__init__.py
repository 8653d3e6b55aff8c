"""Holes in pictures and depths filled from what lies around them."""
