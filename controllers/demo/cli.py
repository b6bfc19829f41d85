"""The command `controllers demo`. Run: `controllers demo --out demo`."""

import json

import typer

from controllers.cli_options import options
from controllers.demo.config import DemoConfig
from runtime import cli as command


@options(DemoConfig)
def demo(config: DemoConfig, as_json: bool) -> None:
    """Run all steps of the project: a film of the shipped model's answers, then collect, train,
    evaluate, serve, drive, and an HTML report.

    To continue an interrupted demo, run the same command again. The exit code is 1 if a result of
    the trained model, for example an error, misses the limit that the demo sets for it.
    """
    from controllers.demo.process import stop_on_sigterm
    from controllers.demo.report import check_limits, print_tables, write_report
    from controllers.demo.run import announce, run_demo

    stop_on_sigterm()
    announce(config)
    result = run_demo(config)
    if config.first_drive:
        if as_json:
            typer.echo(json.dumps(result.as_json()))
        return
    found = check_limits(result)
    report = write_report(config, result)
    if as_json:
        typer.echo(json.dumps(result.as_json()))
    else:
        print_tables(found, result.asked)
        typer.echo(f"report: {report}")
    missed = [one.what for one in found if not one.reached]
    if missed:
        command.fail(
            f"the limit is missed for {', '.join(missed)}; a slower machine needs more --minutes "
            "(with another --out)"
        )
