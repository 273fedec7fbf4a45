"""Quality of a device over time: checks, drift monitor, control charts."""
