"""Verifies recorded rounds and dataset folders, and recovers damaged rounds."""
