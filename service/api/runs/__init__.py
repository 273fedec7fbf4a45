"""Runs: long computations submitted, followed and cancelled."""
