"""Runs the stages of a GPU run one after another and reports the result of each stage."""

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.claims.outcome import exit_code
from benchmarks.gpu.plan import FULL, REHEARSAL, STAGES, Plan
from benchmarks.gpu.process import Interrupted, raise_on_signals
from benchmarks.gpu.report import DONE, FAILED, MAX_BYTES, SKIPPED, STOPPED, Report
from benchmarks.gpu.stages import NEEDS, STAGE_FUNCTIONS, Run, StageFailed
from trackfeatures.errors import UserError

INTERRUPTED = 128
LEAST_SECONDS = 1.0
Stages = Mapping[str, Callable[[Run], dict[str, Any]]]


def run_all(
    work: Path,
    out: Path,
    minutes: float,
    begin: float,
    machine: dict[str, Any],
    *,
    rehearse: bool,
    recipe: str,
    batch: int | None,
    commit: str,
) -> int:
    """Run all stages that are not done, and return the exit code.

    `begin`: start of the run, by `time.monotonic()`. `machine`: a result of `describe_machine`.
    Raises UserError if `minutes` are too few or too many, or if `work` has the results of a
    rehearsal and this run is not a rehearsal, or vice versa.
    """
    plan = Plan(minutes)
    report = Report(work, out, rehearse)
    report.save(machine=machine, minutes=minutes, recipe=recipe, commit=commit)
    raise_on_signals()
    try:
        run_stages(Run(plan, REHEARSAL if rehearse else FULL, report, begin, recipe, batch))
    except Interrupted as interrupted:
        print("interrupted: what is done is kept; the same command goes on", file=sys.stderr)
        return INTERRUPTED + int(interrupted.args[0])
    return finish(report)


def run_stages(task: Run, functions: Stages = STAGE_FUNCTIONS) -> None:
    """Run the stages that are not done, each until its deadline, and write the result of each.

    Raises Interrupted after the results of the interrupted stage are written.
    """
    report = task.report
    for name in STAGES:
        if report.is_done(name):
            continue
        need = NEEDS.get(name)
        if need is not None and not report.is_done(need):
            report.add(name, SKIPPED, 0.0, {"why": f"stage {need} is not done"})
            continue
        begin = time.monotonic()
        seconds = task.plan.seconds(name, begin - task.begin)
        if seconds < LEAST_SECONDS:
            report.add(name, SKIPPED, 0.0, {"why": "no time is left"})
            continue
        print(f"{begin - task.begin:6.1f} s  {name}", file=sys.stderr, flush=True)
        try:
            found, end = functions[name](replace(task, until=begin + seconds)), DONE
        except StageFailed as failed:
            found, end = {**failed.found, "why": str(failed)}, FAILED
        except (UserError, OSError, ValueError, LookupError) as error:
            found, end = {"why": repr(error)}, FAILED
        except Interrupted:
            report.add(name, STOPPED, time.monotonic() - begin, report.stage(name))
            raise
        report.add(name, end, time.monotonic() - begin, found)


def finish(report: Report) -> int:
    """Print the status and the duration of each stage; return the exit code of the run."""
    for name in STAGES:
        stage = report.stage(name)
        why = str(stage.get("why", "")).strip().splitlines()
        print(f"{name:14} {stage['status']:8} {stage['seconds']:6.1f} s  {why[-1] if why else ''}")
    size = report.out_bytes()
    print(f"{report.out}: {size / 2**20:.1f} MiB")
    return exit_code(all(map(report.is_done, STAGES)) and size < MAX_BYTES)
