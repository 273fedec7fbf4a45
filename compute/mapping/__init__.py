"""Space mapping: corrections of readings over object space, built and validated."""
