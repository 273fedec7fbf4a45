"""Sources of line scans behind one small protocol: simulated, replay."""
