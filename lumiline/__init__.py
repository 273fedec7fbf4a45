"""Lumiline for programs that use it: the client, which needs nothing of the server."""
