"""Partial view."""
