"""Runs a finished model on images, without torch: the only part of mtlnet that `serve` imports."""
