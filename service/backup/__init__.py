"""Backup and restore of a database, and the check that what it holds agrees."""
