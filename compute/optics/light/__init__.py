"""Light: what sources send towards the lenses, and what of it makes electrons."""
