"""The dashboard: its build."""
