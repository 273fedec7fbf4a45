"""For all tests: generated examples have no time limit of their own, as machines may be busy."""

import os
from pathlib import Path

from hypothesis import settings

# Every httpx client reads the certificates of all authorities, 36 ms, whatever it then talks to:
# tests talk to servers of their own, and here are no certificates.
os.environ["SSL_CERT_DIR"] = str(Path(__file__).parent)
os.environ.pop("SSL_CERT_FILE", None)

settings.register_profile("lumiline", deadline=None)
settings.load_profile("lumiline")
