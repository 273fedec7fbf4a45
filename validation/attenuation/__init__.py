"""Case attenuation: spherical against cylindrical lens."""
