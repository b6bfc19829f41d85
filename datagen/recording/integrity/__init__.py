"""Verification and recovery of recorded rounds and dataset folders."""
