"""API keys as a REST resource."""
