"""Metrics, records, pictures and the page of a run: facts in, files out."""
