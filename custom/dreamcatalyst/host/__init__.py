"""Guidances under the names and keys of threestudio, for its own systems."""
