"""Splat files: what formats there are, and one entrance for reading and writing all of them."""
