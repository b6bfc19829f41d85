"""Tracks: their geometry, where they come from (own, TORCS, CSV), and the road laid on them."""
