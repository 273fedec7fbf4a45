"""C++ headers of the kernels: how they are read, and what is generated for them from Python."""
