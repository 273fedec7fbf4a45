"""Tool tracking."""
