"""Runs a finished model on images, by default without torch. `serve` imports no other part of
mtlnet."""
