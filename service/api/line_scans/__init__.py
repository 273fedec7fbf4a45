"""REST resource /api/v1/line-scans: what is in the line scans that are posted, and its picture."""
