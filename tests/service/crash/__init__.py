"""The service under load that is cut off: by a kill, or by its database."""
