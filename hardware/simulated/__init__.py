"""A simulated device: light lines of moving markers with a real detector's noise."""
