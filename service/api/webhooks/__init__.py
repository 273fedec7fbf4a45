"""Webhooks: events of holds, devices and drift, sent to addresses that an administrator names."""
