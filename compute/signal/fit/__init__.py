"""Weighted fit of pixel-integrated line shapes: positions at the Cramer-Rao bound."""
