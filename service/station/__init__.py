"""The station: the live pipeline in a process of its own, and the bus to the gateway."""
