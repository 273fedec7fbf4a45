"""Positions at the information bound: the weighted fit of pixel-integrated line shapes."""
