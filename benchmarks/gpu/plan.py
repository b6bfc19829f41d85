"""The stages of a GPU run with their durations, deadlines and amounts of work.

Times are in seconds; deadlines count from the start of the run.
"""

from dataclasses import dataclass

from trackfeatures.errors import UserError

SECONDS = {
    "check": 15.0,
    "forward": 15.0,
    "compile": 45.0,
    "tests": 25.0,
    "collect_test": 30.0,
    "collect_train": 90.0,
    "fast": 25.0,
    "train": 215.0,
    "ship": 15.0,
    "evaluate": 45.0,
    "paper": 75.0,
    "end": 5.0,
}
"""Seconds of each stage in a run of ten minutes, in the order of the stages; runs of other lengths
scale them. Time that a stage leaves goes to the next stages, above all to `train`, which takes all
but the seconds of the stages after it."""
STAGES = tuple(name for name in SECONDS if name not in ("check", "end"))
LEAST_MINUTES, MOST_MINUTES = 1.0, 600.0

LOADED_FRAMES_PER_SECOND = 6_000.0
"""Least speed of reading a dataset for a training: images decoded twice, and the road ahead."""
LOAD_S, FINISH_S = 12.0, 50.0
"""Of `train` in a run of ten minutes: its start, and the fit of the uncertainty head at its end."""
LEAST_TRAINED_SHARE = 0.25
"""Share of `train` that is left to it after delays; and share of its time that is trained at least,
if reading the data should take longer than planned."""


@dataclass(frozen=True)
class Plan:
    """The deadlines of a run of so many minutes."""

    minutes: float

    def __post_init__(self) -> None:
        if not LEAST_MINUTES <= self.minutes <= MOST_MINUTES:
            raise UserError(
                f"--minutes is {self.minutes:g}; give {LEAST_MINUTES:g} to {MOST_MINUTES:g}"
            )

    @property
    def scale(self) -> float:
        """Seconds for each of `SECONDS`."""
        return 60.0 * self.minutes / sum(SECONDS.values())

    def deadline(self, stage: str) -> float:
        """Seconds from the start of the run at which `stage` should have ended."""
        names = list(SECONDS)
        return self.scale * sum(SECONDS[name] for name in names[: names.index(stage) + 1])

    def seconds(self, stage: str, now: float) -> float:
        """Seconds that `stage` may take when it begins at `now`, 0 when the run is over.

        Until its deadline. One that begins late gets its own time all the same, and `train` a
        quarter of it: so `train` makes up for the delays before it, and `paper` for later ones.
        """
        share = LEAST_TRAINED_SHARE if stage == "train" else 1.0
        own = self.scale * share * SECONDS[stage]
        until_end = self.deadline(STAGES[-1]) - now
        return max(min(max(self.deadline(stage) - now, own), until_end), 0.0)

    def train_minutes(self, now: float, frames: int) -> float:
        """Minutes of training steps on `frames` frames when `train` begins at `now` seconds."""
        left = self.seconds("train", now)
        around = self.scale * (LOAD_S + FINISH_S) + frames / LOADED_FRAMES_PER_SECOND
        return max(left - around, LEAST_TRAINED_SHARE * left, 1.0) / 60.0


@dataclass(frozen=True)
class Size:
    """How much a run collects, trains and times."""

    test_rounds: int
    """On the tracks to train on; a fifth of them are train rounds, for the two timed recipes."""
    unseen_rounds: int
    random_rounds: int
    frames: int
    """Of each round of these three."""
    train_frames: int
    """Of each train round."""
    most_train_frames: int
    """In all; what the GPU's memory holds may be fewer."""
    timed_steps: dict[str, int]
    """By recipe."""
    batches: tuple[int, ...]
    """Of the forward passes."""
    passes: int
    """Forward passes of each batch that are timed, after as many for warming up."""
    iterations: int | None
    """Steps of the training; None: as many as its minutes hold."""
    batch: int | None
    """Images a step, unless `--batch` is given; None: the recipe's."""
    device: str


FULL = Size(
    test_rounds=168,
    unseen_rounds=34,
    random_rounds=34,
    frames=150,
    train_frames=400,
    most_train_frames=1_000_000,
    timed_steps={"fast": 20_000, "paper": 150_000},
    batches=(1, 2, 4, 8, 16, 32, 64, 128, 256),
    passes=50,
    iterations=None,
    batch=None,
    device="cuda",
)
REHEARSAL = Size(
    test_rounds=10,
    unseen_rounds=1,
    random_rounds=2,
    frames=6,
    train_frames=8,
    most_train_frames=64,
    timed_steps={"fast": 10, "paper": 10},
    batches=(1, 4),
    passes=2,
    iterations=10,
    batch=16,
    device="cpu",
)
