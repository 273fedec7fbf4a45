"""Line sensors on a serial port: both sides of the protocol in docs/reference/serial-protocol.md."""
