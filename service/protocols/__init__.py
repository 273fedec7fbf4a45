"""Protocols beside REST: websocket stream, OpenIGTLink, NDI and metrics."""
