"""A prepared run on a machine with a GPU: collect, train, evaluate, test and time.

    python benchmarks/gpu_run.py --collect-wheels wheels      # first, on a machine with a network
    python benchmarks/gpu_run.py --minutes 10 --wheels wheels --tracks torcs/tracks --out gpu_run

The machine needs Python 3.12, torch, EGL on the GPU and the packages that
`benchmarks/gpu/packages.toml` lists. It needs no network, no OpenVINO and no PyBullet. If something
is missing, the command lists it and starts nothing. The run ends within `--minutes`: each stage has
a deadline, and the next stages also run after a stage that failed or was stopped. After each stage
the results are written to `--out`: `gpu_run.json`, `curves*.csv` and `model/` (weights in float16
and card). The same command continues a stopped run if the folder `--work` still exists.

`--rehearse` runs all stages on a CPU with a few frames and steps, as a test; its figures mean
nothing.
Exit codes: 0 if all stages are done, 1 if some are not, 3 if something is missing.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import not_measured
from benchmarks.gpu import machine, wheels
from trackfeatures.errors import UserError

RECIPES = ("continue", "fast")


def main() -> int:
    begin = time.monotonic()
    given = parse()
    if given.collect_wheels is not None:
        size = wheels.collect_wheels(given.collect_wheels)
        print(f"{given.collect_wheels}: {size / 1e6:.1f} MB")
        return 0
    work, out = given.work.resolve(), given.out.resolve()
    site = work / "site"
    if given.wheels is not None:
        wheels.install_wheels(given.wheels, site)
    wheels.describe_checkout(site)
    machine.set_paths(site, given.tracks)
    found, lacks = machine.missing_at_all(gpu=not given.rehearse)
    if lacks:
        return not_measured("\n  ".join(["this machine lacks", *lacks]))
    from benchmarks.gpu.running import run_all  # imports packages that the wheels installed

    return run_all(
        work,
        out,
        given.minutes,
        begin,
        found,
        rehearse=given.rehearse,
        recipe=given.recipe,
        batch=given.batch,
        commit=commit(),
    )


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the whole run")
    parser.add_argument(
        "--out", type=Path, default=Path("build/gpu_run/out"), help="folder for the results"
    )
    parser.add_argument(
        "--work", type=Path, default=Path("build/gpu_run/work"), help="folder for everything else"
    )
    parser.add_argument("--wheels", type=Path, help="folder of wheels to install first")
    parser.add_argument("--tracks", type=Path, help="folder of TORCS's tracks; else $TORCS_TRACKS")
    parser.add_argument("--recipe", choices=RECIPES, default=RECIPES[0])
    parser.add_argument("--batch", type=int, help="batch size of the training")
    parser.add_argument("--rehearse", action="store_true", help="run on a CPU, with little data")
    parser.add_argument(
        "--collect-wheels", type=Path, metavar="FOLDER", help="only download the wheels"
    )
    return parser.parse_args()


def commit() -> str:
    """Return the hash of this checkout's commit, or "" if git is missing or this is no git
    repository."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        done = subprocess.run(command, cwd=wheels.ROOT, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return done.stdout.strip()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(f"error: {error}")
