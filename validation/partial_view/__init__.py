"""Case partial-view: a tool of which each marker is seen by two sensors."""
