"""OpenIGTLink: poses of tools for navigation software, and what it may ask for and command."""
