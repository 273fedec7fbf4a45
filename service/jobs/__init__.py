"""Jobs: long computations (runs), each in a process beside the server."""
