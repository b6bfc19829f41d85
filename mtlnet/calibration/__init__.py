"""Calibrates cameras from pictures of a board (the lens) or a film of a drive (the mount)."""
