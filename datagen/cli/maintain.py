"""The commands that look after recorded rounds: `datagen recover` and `datagen split`.

datagen recover datasets/default/rounds/r007.mcap
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from runtime.cli import AsJson, counted, print_result
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from datagen.recording.near_duplicates import Tolerances


def recover(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A damaged round.")],
    out: Annotated[
        Path | None,
        typer.Option(help="The new file; else beside it, or in DIR/recovered for DIR/rounds."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Save the whole frames of a cut or damaged round into a new file, marked as recovered."""
    from datagen.recording.integrity.recover import recover as run

    done = run(file, out)
    least = "at least " if done.at_least else ""
    line = f"{done.out}: {counted(done.saved, 'frame')} saved, {least}{done.lost} lost"
    print_result(done.as_json(), as_json, line)


def split(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A dataset folder.")],
    name: Annotated[str, typer.Option(help="Which split: splits/NAME.json.")] = "default",
    by: Annotated[
        str, typer.Option(help="Make it: divide by round, or by track (whole tracks held back).")
    ] = "",
    test_share: Annotated[float, typer.Option(help="With --by: share of rounds to test.")] = 0.25,
    seed: Annotated[int, typer.Option(help="With --by: another seed, another choice.")] = 0,
    with_recovered: Annotated[
        bool, typer.Option("--with-recovered", help="With --by: take recovered rounds too.")
    ] = False,
    near: Annotated[
        str, typer.Option(help="Near is within: m along the road, m across it, deg of yaw.")
    ] = "0.5,0.1,0.5",
    as_json: AsJson = False,
) -> None:
    """Check a split, or make one with --by: no round, seed or content on two sides.

    Tells how many frames have a near twin in train: road, place, offset,
    yaw and light. One that leaks is refused, one that exists is kept.
    """
    from datagen.recording.split_report import SplitConfig, check_split, format_report, make_split

    tolerances = _tolerances(near)
    if by:
        make_split(folder, name, SplitConfig(by, test_share, seed, with_recovered))
    report = check_split(folder, name, tolerances, made=bool(by))
    print_result(report.as_json(), as_json, format_report(report))


def _tolerances(text: str) -> "Tolerances":
    from datagen.recording.near_duplicates import Tolerances

    try:
        s, offset, yaw = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(f"--near is {text!r}; give three numbers, as 0.5,0.1,0.5") from error
    if not all(0.0 < value < float("inf") for value in (s, offset, yaw)):
        raise UserError(f"--near is {text!r}; give numbers above 0")
    return Tolerances(s, offset, yaw)
