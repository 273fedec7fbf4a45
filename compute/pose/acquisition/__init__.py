"""Acquisition of a tool that is not tracked: its markers among the peaks, and its first pose."""
