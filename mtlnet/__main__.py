"""`python -m mtlnet` is the `mtlnet` command."""

from mtlnet.cli import main

main()
