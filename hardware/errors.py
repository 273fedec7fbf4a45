"""Driver errors: device not connected, device changed, library missing."""

from compute.errors import LumilineError


class DeviceNotConnected(LumilineError):
    """The device does not answer: unplugged, switched off, in use by another program, or silent."""


class DeviceChanged(LumilineError):
    """The reconnected device has other sensors, or other sensor properties, than before."""


class MissingLibrary(LumilineError):
    """A system library that the driver needs is not installed."""
