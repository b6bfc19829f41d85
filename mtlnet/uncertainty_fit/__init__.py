"""Fits the uncertainty head of a trained network; the network itself is frozen."""
