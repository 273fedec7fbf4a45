"""REST resource /api/v1/device-profiles: published devices and their predicted accuracy."""
