"""REST resource /api/v1/line-scans: peaks of posted line scans, and their plot."""
