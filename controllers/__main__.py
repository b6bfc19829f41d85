"""Runs the command `controllers` as `python -m controllers`."""

from controllers.cli import main

main()
