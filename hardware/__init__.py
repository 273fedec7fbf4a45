"""Drivers of line sensors: serial, GenICam, TCD1304, simulated, replay."""
