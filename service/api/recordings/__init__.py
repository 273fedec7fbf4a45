"""Recordings: line scans and results of devices in files, and what is made of them again."""
