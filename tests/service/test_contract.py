"""The served application keeps its OpenAPI contract under generated requests, all checks on."""
