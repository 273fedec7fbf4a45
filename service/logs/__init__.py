"""Log lines: their form, and which request or device they are of."""
