"""Lateral controllers, closed-loop driving, and the demo of the whole pipeline."""
