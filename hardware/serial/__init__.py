"""Line sensors on a serial port: host and device (docs/reference/serial-protocol.md)."""
