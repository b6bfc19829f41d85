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
    "train": 202.0,
    "ship": 15.0,
    "evaluate": 45.0,
    "paper": 75.0,
    "end": 18.0,
}
"""Seconds of each stage in a run of ten minutes, in the order of the stages. In a run of another
length they are scaled. Time that a stage does not use goes to the next stages. Most of it goes to
`train`, which leaves the stages after it only their own seconds."""
STAGES = tuple(name for name in SECONDS if name not in ("check", "end"))
LEAST_MINUTES, MOST_MINUTES = 1.0, 600.0

LOADED_FRAMES_PER_SECOND = 6_000.0
"""Lowest expected speed of reading a dataset for a training. While a dataset is read, each image is
decoded twice, and the road ahead is read."""
LOAD_S, FINISH_S = 12.0, 50.0
"""Seconds that the stage `train` needs in a run of ten minutes for its start (LOAD_S), and for the
fit of the uncertainty head at its end (FINISH_S)."""
LEAST_TRAINED_SHARE = 0.25
"""Least share of its planned seconds that the stage `train` gets if earlier stages took too long.
Also the least share of the time of `train` that is used for training steps if reading the data
takes longer than planned."""


@dataclass(frozen=True)
class Plan:
    """The deadlines of a run of `minutes` minutes. Raises UserError for too few or too many
    minutes."""

    minutes: float

    def __post_init__(self) -> None:
        if not LEAST_MINUTES <= self.minutes <= MOST_MINUTES:
            raise UserError(
                f"--minutes is {self.minutes:g}; give {LEAST_MINUTES:g} to {MOST_MINUTES:g}"
            )

    @property
    def scale(self) -> float:
        """Factor on SECONDS: the length of this run (s) divided by the sum of SECONDS."""
        return 60.0 * self.minutes / sum(SECONDS.values())

    def deadline(self, stage: str) -> float:
        """Seconds from the start of the run at which `stage` should have ended."""
        names = list(SECONDS)
        return self.scale * sum(SECONDS[name] for name in names[: names.index(stage) + 1])

    def seconds(self, stage: str, now: float) -> float:
        """Return the seconds that `stage` may take when it begins at `now` (s from the start of the
        run); 0 when the run is over.

        A stage may take until its deadline. If it begins late, it may take at least its planned
        seconds, but not longer than until the end of the run. `train` may then take at least a
        quarter of its planned seconds, so it makes up for earlier delays. The last stage, `paper`,
        makes up for delays after `train`.
        """
        share = LEAST_TRAINED_SHARE if stage == "train" else 1.0
        own = self.scale * share * SECONDS[stage]
        until_end = self.deadline(STAGES[-1]) - now
        return max(min(max(self.deadline(stage) - now, own), until_end), 0.0)

    def train_minutes(self, now: float, frames: int) -> float:
        """Return the minutes for training steps on `frames` frames if the stage `train` begins at
        `now` (s from the start of the run)."""
        left = self.seconds("train", now)
        around = self.scale * (LOAD_S + FINISH_S) + frames / LOADED_FRAMES_PER_SECOND
        return max(left - around, LEAST_TRAINED_SHARE * left, 1.0) / 60.0


@dataclass(frozen=True)
class Size:
    """The amounts of data, training steps and timed passes of a run."""

    test_rounds: int
    """Number of rounds of the dataset `test`. A fifth of them are train rounds, with which the two
    timed recipes train."""
    unseen_rounds: int
    random_rounds: int
    frames: int
    """Number of frames in each round of the three datasets for evaluation."""
    train_frames: int
    """Number of frames in each round of the dataset `train`."""
    most_train_frames: int
    """Largest number of frames of the dataset `train`; fewer if the GPU's memory is too small."""
    timed_steps: dict[str, int]
    """Number of training steps of the timed trainings, by recipe."""
    batches: tuple[int, ...]
    """Batch sizes of the forward passes."""
    passes: int
    """Number of timed forward passes for each batch size, after the same number for warming up."""
    iterations: int | None
    """Number of steps of the training; None: as many as fit into the minutes of the stage."""
    batch: int | None
    """Batch size of the training, unless `--batch` is given; None: the batch size of the recipe."""
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
