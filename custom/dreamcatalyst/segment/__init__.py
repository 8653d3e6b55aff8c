"""Masks: which splats an edit may change."""
