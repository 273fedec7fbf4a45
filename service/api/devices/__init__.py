"""Devices: what is read, by which driver, and what it is doing."""
