"""Cases about aberrations: sections 3.3 and 3.4 of the thesis, Tables 3.1, 3.2, A.1 and A.2."""
