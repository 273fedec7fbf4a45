"""Case section-6.1: two active markers."""
