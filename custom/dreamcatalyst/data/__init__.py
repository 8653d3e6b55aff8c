"""Captures: photographs with their cameras, whatever format they came in."""
