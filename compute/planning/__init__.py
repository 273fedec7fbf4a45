"""Planning: coverage, precision, ghost points and data rates of a device from its profile."""
