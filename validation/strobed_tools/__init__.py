"""Strobed tools."""
