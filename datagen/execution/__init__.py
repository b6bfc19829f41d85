"""Collecting: processes or a Ray cluster that record a plan's rounds, locks, retries, merging."""
