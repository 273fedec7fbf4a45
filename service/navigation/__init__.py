"""What the ports that navigation software connects to have in common."""
