"""Runs the `simulator` command for `python -m simulator`."""

from simulator.cli import main

main()
