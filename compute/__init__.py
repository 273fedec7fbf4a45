"""Science: arrays in, arrays out. No I/O, no clock, no database."""
