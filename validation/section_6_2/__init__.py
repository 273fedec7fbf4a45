"""Case section-6.2: three passive markers."""
