"""Native sources of the kernels: C++ for the CPU and for CUDA, from lines to peaks.

They are native, because the compiler vectorises their search for bright pixels and does not
vectorise a loop of Warp's own over the pixels (a factor of eight on the CPU). Every decision is
taken in integers, so that all devices take the same.

On the CPU one thread takes a line from its first pixel to its last. On CUDA a warp takes a few
lines: its 32 lanes read them together, 16 bytes at a time, and note the groups of pixels that
hold a bright one; then each lane takes one of these and looks for maxima in it; then each takes
one peak and measures it. With all lines' peaks together the lanes are busy.
"""
