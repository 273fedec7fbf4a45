"""Wand."""
