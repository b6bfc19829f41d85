"""The supervisor and its worker processes: start, stop, replacement, new weights, commands."""
