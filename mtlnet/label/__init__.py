"""Labelling pictures by hand in the browser: `mtlnet label FOLDER`."""
