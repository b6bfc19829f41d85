"""The command `datagen`: collect, check, describe and export datasets.

datagen collect --rounds 60 --out datasets/default
"""

import typer

from datagen.cli.collect import collect, merge
from datagen.cli.inspect import export, info, stats, view
from datagen.cli.maintain import recover, split, verify
from datagen.cli.protocol import protocol
from runtime import cli as command

app = typer.Typer(
    help="Record images of the driver's view with their track features, and check and export "
    "the recorded datasets.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for function in (collect, protocol, merge, verify, info, recover, split, view, stats, export):
    app.command()(function)


def main() -> None:
    """Run the command line."""
    command.main(app)
