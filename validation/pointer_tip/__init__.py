"""Pointer tip."""
