"""docs/architecture.md agrees with what runs."""
