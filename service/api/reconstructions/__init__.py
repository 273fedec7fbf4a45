"""Reconstructions: points from readings that a client posts."""
