"""REST resources of an installation: its settings and its backups."""
