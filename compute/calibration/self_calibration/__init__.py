"""Self-calibration: sensors from a wand, a rigid body or a frame at unknown poses."""
