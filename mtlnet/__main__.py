"""Runs the `mtlnet` command for `python -m mtlnet`."""

from mtlnet.cli import main

main()
