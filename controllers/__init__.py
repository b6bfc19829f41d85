"""Lateral controllers and the closed-loop drive."""
