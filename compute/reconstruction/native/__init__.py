"""Native source of the triangulation kernel, for the CPU and CUDA."""
