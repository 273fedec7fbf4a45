"""The tracking service: REST, websocket streams, database, live pipeline, command line."""
