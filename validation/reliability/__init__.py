"""Case reliability: readings that lie, of points and of tools, beside the theory of their tests."""
