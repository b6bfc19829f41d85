"""Runs the command `serve` for `python -m serve`."""

from serve.cli import main

main()
