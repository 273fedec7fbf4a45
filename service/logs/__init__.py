"""Logging: format, redaction, and the request or device of a line."""
