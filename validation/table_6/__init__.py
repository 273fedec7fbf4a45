"""Tables 6.1 and 6.2: two moving markers."""
