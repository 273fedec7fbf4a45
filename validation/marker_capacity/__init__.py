"""Case marker-capacity: number of markers that can be lit at once."""
