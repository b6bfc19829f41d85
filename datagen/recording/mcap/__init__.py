"""Reads and writes MCAP files: records, chunks, indexes and serialised messages."""
