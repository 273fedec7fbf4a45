"""Exact ray tracing: surfaces, lenses and stops."""
