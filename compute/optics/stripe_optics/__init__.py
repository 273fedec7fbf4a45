"""Images of points as stripes on a row of pixels: exact ray traces, and tables of them."""
