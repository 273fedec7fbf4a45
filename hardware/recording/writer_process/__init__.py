"""Recording in a separate process, fed through shared memory."""
