"""Runs a collection: processes or a Ray cluster record the rounds of a plan. Merges datasets."""
