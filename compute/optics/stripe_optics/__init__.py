"""Light lines on a row of pixels, from traced rays: exactly, and from tables of exact traces."""
