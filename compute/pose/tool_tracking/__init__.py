"""Tool tracking: state of each tool from exposure to exposure, and its reported pose."""
