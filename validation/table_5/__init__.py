"""Tables 5.1 to 5.14."""
