"""Problem documents (RFC 9457): the service's errors, their types and handlers."""
