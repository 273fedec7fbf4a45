"""Passive detection."""
