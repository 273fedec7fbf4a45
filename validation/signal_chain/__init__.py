"""Cases about the thesis's signal chain: Tables 4.1 to 4.5 and C."""
