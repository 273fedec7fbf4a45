"""Coded apertures: windows with a bar code, and plates with Gray-coded tracks."""
