"""Perception of the road for a controller: its sources, and late, lost or uncertain answers."""
