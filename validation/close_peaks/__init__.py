"""Case close-peaks: two peaks that overlap."""
