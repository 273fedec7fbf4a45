"""Runs: what takes longer than a request, computed in processes beside the server."""
