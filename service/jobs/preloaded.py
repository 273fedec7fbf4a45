"""What worker processes need, loaded once by the process that they are forked from."""

import importlib
import os
import signal
from contextlib import suppress
from typing import Final

from service.jobs.worker import THREAD_VARIABLES

_MODULES: Final = (
    "service.api.json_body",
    "service.api.line_scans.schema",
    "service.api.reconstructions.schema",
    "service.api.runs.kind_registry",
    "service.api.tools.registration_schema",
)
"""Modules that workers load sooner or later, and those that these import."""

# A library with threads of its own could not be forked.
for _variable in THREAD_VARIABLES:
    os.environ[_variable] = "1"
# A service manager's signal goes to all processes; the service decides what becomes of them.
for _name in ("SIGTERM", "SIGHUP"):
    if hasattr(signal, _name):
        signal.signal(getattr(signal, _name), signal.SIG_IGN)
for _module in _MODULES:
    with suppress(ImportError):  # whoever needs it is told why
        importlib.import_module(_module)
