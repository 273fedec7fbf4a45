"""Planning: what a device will reach, worked out before it is built."""
