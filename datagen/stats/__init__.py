"""Writes the statistics page of a dataset: distributions, balance, warnings, sample frames."""
