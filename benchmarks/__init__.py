"""Benchmarks against the libraries that a user would otherwise choose."""
