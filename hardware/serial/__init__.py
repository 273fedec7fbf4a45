"""Line sensors on a serial port: the protocol of docs/serial-protocol.md, host and device side."""
