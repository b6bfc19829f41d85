"""Import of TORCS track files (XML)."""
