"""Kinds of runs: one module each, with stored request, computation and result."""
