"""Line sensors on a serial port: the protocol of docs/reference/serial-protocol.md, host and device side."""
