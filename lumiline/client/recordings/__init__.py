"""Recordings, their exports, and runs."""
