"""Native strobed-step kernel: a strobed tool from one exposure to the next, on the CPU."""
