"""Tracks: their geometry, their file formats (own, TORCS, CSV), and the road along a track."""
