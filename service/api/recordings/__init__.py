"""Recordings: line scans and results of devices in files, and their reprocessing."""
