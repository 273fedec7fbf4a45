"""Case wand."""
