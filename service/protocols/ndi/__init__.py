"""Server for the common API of NDI's trackers: software with an NDI driver gets our poses."""
