"""What runs compute in their processes, with what they keep of requests: no database, no HTTP."""
