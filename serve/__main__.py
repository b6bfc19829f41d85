"""`python -m serve` runs the command `serve`."""

from serve.cli import main

main()
