"""Captures: guided from target to target, what a device reads of a marker held at each."""
