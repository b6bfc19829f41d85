"""Speed of the service in this checkout compared with another checkout, in one run.

Each pair of measurements starts both services with the same model, one after the other; the order
alternates from pair to pair. A measurement has the time from the command to the first answer in s,
the times of an answer over one connection, the answers per second over eight connections, and the
processor time of an answer.

    python benchmarks/service_versions.py --before CHECKOUT [--model RUN] [--pairs 9]
        [--seconds 8] [--out FILE]
    claim: for each time, the median over the pairs of the ratio of the time in this checkout to the
    time in CHECKOUT is at most 1.03

CHECKOUT is a clone of this repository at another commit; it runs in the environment of this one.
Without --model the weights are untrained: each checkout writes them in its own format, from the
same seed. A given model must have a format that both checkouts read.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, not_measured, run_command
from benchmarks.service_load.servers import (
    OURS,
    ROOT,
    Loader,
    descendants,
    model_copy,
    processor_s,
    running,
)

CLAIM = 1.03
CONNECTIONS = 8
PUBLISH = """
import pathlib, sys
from tests.serve.conftest import publish_untrained
publish_untrained(pathlib.Path(sys.argv[1]), seed=3)
"""


@contextmanager
def models(run: Path | None, trees: Mapping[str, Path]) -> Iterator[dict[str, Path]]:
    """Yield the folder of the model that each source tree in `trees` serves, by the tree's name.

    The folder is a copy of `run`. If `run` is None, each tree writes untrained weights in its own
    format.
    """
    if run is not None:
        with model_copy(run) as copy:
            yield dict.fromkeys(trees, copy)
        return
    with tempfile.TemporaryDirectory() as folder:
        found = {name: Path(folder) / name for name in trees}
        for name, root in trees.items():
            # "-c" looks for modules in the working folder first.
            subprocess.run([sys.executable, "-c", PUBLISH, found[name]], cwd=root, check=True)
        yield found


def measure(root: Path, run: Path, loader: Loader, seconds: float) -> dict[str, float]:
    """Start the service of the source tree `root` and return its times; a lower time is better.

    All times except `start_s` are in ms. Each of the two loads lasts `seconds`.
    """
    begin = time.perf_counter()
    with running(OURS, Path(sys.executable), run, 1, root=root) as port:
        start_s = time.perf_counter() - begin
        loader.run(port, 1, 1.0)
        service = descendants(os.getpid())
        before_s = processor_s(service)
        alone = loader.run(port, 1, seconds)
        spent_s = processor_s(service) - before_s
        many = loader.run(port, CONNECTIONS, seconds)
    return {
        "start_s": start_s,
        "p50_ms": alone.percentile(50),
        "p99_ms": alone.percentile(99),
        "processor_ms": 1e3 * spent_s / float((alone.status == 200).sum()),
        "ms_per_answer_of_many": 1e3 / many.per_second(),
    }


def main(
    before: Path | None = None,
    model: Path | None = None,
    pairs: int = 9,
    seconds: float = 8.0,
    out: Path | None = None,
) -> None:
    if before is None:
        not_measured("give --before, a clone at another commit")
    trees = {"before": before.resolve(), "after": ROOT}
    measured = []
    with tempfile.TemporaryDirectory() as folder, models(model, trees) as runs:
        loader = Loader(Path(folder))
        for number in range(pairs):
            order = list(trees) if number % 2 else list(trees)[::-1]
            found = {n: measure(trees[n], runs[n], loader, seconds) for n in order}
            measured.append(found)
            print(found, file=sys.stderr, flush=True)
    result = {}
    for name in measured[0]["after"]:
        ratios = [pair["after"][name] / pair["before"][name] for pair in measured]
        result[name] = {
            **{side: round(median(pair[side][name] for pair in measured), 3) for side in trees},
            "ratio": round(median(ratios), 3),
        }
    held = all(figures["ratio"] <= CLAIM for figures in result.values())
    conclude({"medians": result, "pairs": measured}, out, held)


if __name__ == "__main__":
    run_command(main)
