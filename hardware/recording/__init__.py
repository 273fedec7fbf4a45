"""Recordings: HDF5 files of frames and results, their writer and reader."""
