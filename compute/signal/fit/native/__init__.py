"""C++ source of the fit of peaks, for the CPU and CUDA."""
