"""What programs connect to beside REST: websocket stream, OpenIGTLink, NDI and metrics."""
