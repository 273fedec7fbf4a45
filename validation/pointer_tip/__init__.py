"""Case pointer-tip."""
