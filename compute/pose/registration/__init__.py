"""Registration: by paired points, by a surface, and the frame of three markers."""
