"""Bridges over the road: selects their positions and builds their triangles."""
