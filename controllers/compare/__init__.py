"""Compares controllers on tracks (results, tables, curves) and tunes their parameters."""
