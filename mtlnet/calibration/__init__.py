"""Cameras from what people have: pictures of a board, or a film of a drive."""
