"""Who may do what: keys, tokens, scopes, and the guard before every operation."""
