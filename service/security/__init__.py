"""Security: keys, tokens, scopes, and the guard before every operation."""
