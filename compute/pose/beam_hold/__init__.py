"""Beam hold."""
