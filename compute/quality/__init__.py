"""How good is a device today? Tests with points and distances, and charts of them over time."""
