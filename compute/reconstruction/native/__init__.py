"""Native source of the kernel that makes points of readings, for the CPU and CUDA."""
