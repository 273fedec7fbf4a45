"""Independent references: each works out its answer another way than the code that it judges."""
