"""The 1D camera: a sensor behind a cylindrical lens, one reading for each point."""
