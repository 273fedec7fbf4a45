"""Space mapping: corrections of readings over object space, built, validated and applied."""
