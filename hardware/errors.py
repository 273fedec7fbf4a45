"""Errors of drivers that their device causes: it is not there, or is another one."""

from compute.errors import LumilineError


class DeviceNotConnected(LumilineError):
    """The device does not answer: unplugged, switched off, taken by another program, or silent."""

    code = "device-not-connected"


class DeviceChanged(LumilineError):
    """What is connected now has other sensors than before, or other values of them."""

    code = "device-changed"


class MissingLibrary(LumilineError):
    """A driver needs a library of the system that is not installed."""

    code = "missing-library"
