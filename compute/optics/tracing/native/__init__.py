"""C++ source of the ray tracing kernel, for the CPU and CUDA."""
