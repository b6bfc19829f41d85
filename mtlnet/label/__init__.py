"""Labelling pictures by hand: `mtlnet label FOLDER`."""
