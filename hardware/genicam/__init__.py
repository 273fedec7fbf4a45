"""GenICam line-scan cameras (GigE Vision, USB3 Vision) through the library Aravis."""
