"""Case passive-detection: faint passive markers."""
