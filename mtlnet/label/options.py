"""Refuses options of `mtlnet label` that have no effect with, or without, --import."""

import typer

from trackfeatures.errors import UserError

ONLY_IMPORT = {"label_std": "--label-std", "as_json": "--json"}
ONLY_PAGE = {
    "model": "--model",
    "no_model": "--no-model",
    "host": "--host",
    "port": "--port",
    "token_file": "--token-file",
    "insecure": "--insecure",
}


def check_options(context: typer.Context) -> None:
    """Raise UserError for options that the user gave and that would have no effect. `context` is
    that of `mtlnet label`."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = {name for name, one in sources.items() if one and one.name == "COMMANDLINE"}
    if "table" not in given:
        for name in ONLY_IMPORT.keys() & given:
            raise UserError(f"{ONLY_IMPORT[name]} belongs to --import; give both, or none")
        return
    if "camera" in given:
        raise UserError("--import takes the cameras from its table; leave --camera out")
    useless = [option for name, option in ONLY_PAGE.items() if name in given]
    if useless:
        raise UserError(f"--import does not open the page; leave {', '.join(useless)} out")
