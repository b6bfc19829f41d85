"""Bridges over the road: where they stand and how they are built."""
