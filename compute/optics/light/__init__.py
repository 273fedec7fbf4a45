"""Light of the markers: emission, spectra, photoelectrons."""
