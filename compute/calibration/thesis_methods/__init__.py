"""Thesis methods."""
