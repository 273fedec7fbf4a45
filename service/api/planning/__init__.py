"""REST resource /api/v1/device-profiles: published devices, and what they would reach."""
