"""The speed of the service in this checkout beside that of another one, in one run.

Each of a number of pairs starts both with the same model, one after the other, the order changing
from pair to pair, and measures: seconds from the command to the first answer, times of an answer
over one connection, answers a second over eight, and the processor time of an answer.

    python benchmarks/service_versions.py --before CHECKOUT [--model RUN] [--pairs 9]
        [--seconds 8] [--out FILE]          claim: no median of the pairs is over 3 % worse

CHECKOUT is a clone of this repository at another commit; it runs in this environment. Without
--model the weights are untrained, and each of the two writes them in its own format, from the same
seed. A model that is given must be in a format that both read.
"""

import argparse
import json
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

from benchmarks.material.outcome import exit_code, not_measured
from benchmarks.material.servers import OURS, ROOT, Loader, descendants, model, running

CLAIM = 1.03
CONNECTIONS = 8
TICKS = os.sysconf("SC_CLK_TCK")
PUBLISH = """
import pathlib, sys
from tests.serve.conftest import publish_untrained
publish_untrained(pathlib.Path(sys.argv[1]), seed=3)
"""


def processor_s(pids: list[int]) -> float:
    """Processor time of some processes so far, s."""
    total = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / TICKS


@contextmanager
def models(run: Path | None, trees: Mapping[str, Path]) -> Iterator[dict[str, Path]]:
    """The model that each source tree serves: `run`, or None: untrained weights in its format."""
    if run is not None:
        with model(run) as copy:
            yield dict.fromkeys(trees, copy)
        return
    with tempfile.TemporaryDirectory() as folder:
        found = {name: Path(folder) / name for name in trees}
        for name, root in trees.items():
            # "-c" looks for modules in the working folder first.
            subprocess.run([sys.executable, "-c", PUBLISH, found[name]], cwd=root, check=True)
        yield found


def measure(root: Path, run: Path, loader: Loader, seconds: float) -> dict[str, float]:
    """The figures of the service of one source tree; in all of them less is better."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, help="the other checkout")
    parser.add_argument("--model", type=Path, help="a run's folder; without it untrained weights")
    parser.add_argument("--pairs", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each load")
    parser.add_argument("--out", type=Path, help="write the figures here, too")
    options = parser.parse_args()
    if options.before is None:
        sys.exit(not_measured("give --before, a clone at another commit"))
    trees = {"before": options.before.resolve(), "after": ROOT}
    pairs = []
    with tempfile.TemporaryDirectory() as folder, models(options.model, trees) as runs:
        loader = Loader(Path(folder))
        for number in range(options.pairs):
            order = list(trees) if number % 2 else list(trees)[::-1]
            found = {n: measure(trees[n], runs[n], loader, options.seconds) for n in order}
            pairs.append(found)
            print(json.dumps(found), file=sys.stderr, flush=True)
    result = {}
    for name in pairs[0]["after"]:
        result[name] = {
            **{side: round(median(pair[side][name] for pair in pairs), 3) for side in trees},
            "ratio": round(median(pair["after"][name] / pair["before"][name] for pair in pairs), 3),
        }
    print(json.dumps(result, indent=1))
    if options.out is not None:
        options.out.write_text(json.dumps({"medians": result, "pairs": pairs}, indent=1) + "\n")
    sys.exit(exit_code(all(figures["ratio"] <= CLAIM for figures in result.values())))


if __name__ == "__main__":
    main()
