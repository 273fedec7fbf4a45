"""Exact geometrical optics: surfaces, lenses and stops, rays through them."""
