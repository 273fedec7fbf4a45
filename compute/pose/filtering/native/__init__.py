"""Native source of a strobed tool's step from one exposure to the next, for the CPU."""
