"""Registrations, and the transforms between frames."""
