"""Case strobed-tools."""
