"""Aberrations: paraxial optics, third-order coefficients, distortion over both field angles."""
