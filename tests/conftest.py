"""For all tests: generated examples have no time limit of their own, as machines may be busy."""

from hypothesis import settings

settings.register_profile("lumiline", deadline=None)
settings.load_profile("lumiline")
