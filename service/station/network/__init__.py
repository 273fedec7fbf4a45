"""The bus between machines: NATS."""
