"""Map bound."""
