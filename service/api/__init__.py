"""The REST resources: one folder each, with router, schema and store."""
