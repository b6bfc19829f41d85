"""`python -m controllers` is the `controllers` command."""

from controllers.cli import main

main()
