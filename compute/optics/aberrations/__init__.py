"""Aberrations: paraxial optics, Seidel coefficients, distortion over both field angles."""
