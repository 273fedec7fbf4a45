"""Table 1.1: published resolution and accuracy of devices."""
