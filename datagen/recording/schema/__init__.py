"""Defines topics and messages of a recording and describes their fields."""
