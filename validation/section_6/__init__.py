"""Scenes and metrics that the cases of chapter 6 share."""
