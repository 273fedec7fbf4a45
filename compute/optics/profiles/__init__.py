"""Device profiles: what is published of a device, and what had to be assumed, as one text file."""
