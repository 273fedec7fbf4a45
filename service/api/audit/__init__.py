"""The audit log as a REST resource: who changed what."""
