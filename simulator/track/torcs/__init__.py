"""Imports TORCS track files (XML)."""
