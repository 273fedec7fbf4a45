"""Bundle adjustment of 1D cameras: sensors, bodies' shapes and poses from readings, jointly."""
