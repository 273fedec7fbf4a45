"""Published tables and tests, reproduced: printed figures beside those of this software."""
