"""The minutes of a GPU run's stages, and what it collects."""

from itertools import pairwise
from pathlib import Path

import pytest

from benchmarks.gpu import stages
from benchmarks.gpu.collecting import (
    SEEDS,
    counted,
    evaluation_collections,
    most_frames,
    train_collections,
)
from benchmarks.gpu.plan import FULL, REHEARSAL, SECONDS, STAGES, Plan
from benchmarks.gpu.process import GRACE_S, Ended
from mtlnet.inference.model_card import read_card
from mtlnet.inference.shipped_models import SHIPPED
from mtlnet.inference.trained_rounds import Seeds
from tests.mtlnet.conftest import write_dataset
from trackfeatures.errors import UserError


def test_deadlines_are_shares_of_the_minutes() -> None:
    plan = Plan(10.0)
    assert sum(SECONDS.values()) == 600.0
    deadlines = [plan.deadline(stage) for stage in STAGES]
    assert all(a < b for a, b in pairwise(deadlines))
    # A command that is stopped has 12 s to save its work, and 6 s are left to end.
    assert 600.0 - deadlines[-1] == GRACE_S + 6.0
    assert (plan.deadline("forward"), plan.deadline("fast"), plan.deadline("train")) == (
        *(30.0, 245.0, 447.0),
    )
    assert [Plan(3.0).deadline(stage) for stage in STAGES] == pytest.approx(
        [0.3 * deadline for deadline in deadlines]
    )
    assert set(stages.STAGE_FUNCTIONS) == set(STAGES) == set(SECONDS) - {"check", "end"}
    for minutes in (0.5, 601.0, float("nan")):
        with pytest.raises(UserError, match="give 1 to 600"):
            Plan(minutes)


def test_the_training_takes_what_its_start_and_end_and_the_earlier_stages_leave() -> None:
    plan = Plan(10.0)
    on_time = plan.train_minutes(245.0, 60_000)
    assert on_time == pytest.approx((202 - 12 - 50 - 10) / 60)
    assert plan.train_minutes(185.0, 60_000) == pytest.approx(on_time + 1.0)
    assert plan.train_minutes(245.0, 10**7) == pytest.approx(0.25 * 202 / 60)
    assert plan.train_minutes(594.5, 0) == pytest.approx(1 / 60)


def test_a_stage_that_begins_late_has_its_own_time_until_the_run_ends() -> None:
    plan = Plan(10.0)
    assert plan.seconds("forward", 10.0) == 20.0  # five seconds were left before it
    assert plan.seconds("forward", 60.0) == 15.0
    assert plan.seconds("train", 300.0) == 147.0
    assert plan.seconds("train", 450.0) == 0.25 * 202.0
    assert plan.seconds("paper", 500.0) == 82.0
    assert plan.seconds("paper", 560.0) == 22.0
    assert plan.seconds("paper", 600.0) == 0.0


def test_collections_share_the_cores_and_no_seed() -> None:
    parts = train_collections(FULL, 16, 200_000)
    assert [part.workers for part in parts] == [4, 4, 4, 4]
    assert sum(part.rounds * part.frames for part in parts) == 200_000
    assert ["random" in part.options for part in parts] == [False, True, False, True]
    sets = evaluation_collections(FULL, 16)
    assert [(each.name, each.rounds * each.frames) for each in sets] == [
        ("test", 25_200),  # of which 20,000 are test frames
        ("unseen", 5_100),
        ("random", 5_100),
    ]
    assert 16 <= sum(each.workers for each in sets) <= 18
    seeds = [each.seed for each in (*parts, *sets)]
    assert len({*seeds}) == len(seeds) == len({each.name for each in (*parts, *sets)})
    trained = Seeds.read(read_card(SHIPPED).data["seeds"])
    trained_on = {seed // 10**6 for part in trained.ranges for seed in part}
    assert 1601 in trained_on
    assert not trained_on & {*seeds, *SEEDS.values()}
    assert [part.workers for part in train_collections(REHEARSAL, 2, 64)] == [1, 1]


def test_no_more_frames_than_the_gpu_holds() -> None:
    assert most_frames(FULL, 0) == FULL.most_train_frames
    frames = most_frames(FULL, 80 * 10**9)
    assert frames * 144 * 280 * 3 == pytest.approx(40e9, rel=1e-4)


def test_collections_that_were_stopped_count_their_finished_rounds(tmp_path: Path) -> None:
    (part,) = train_collections(REHEARSAL, 2, 8)[:1]
    (tmp_path / part.name).mkdir()
    found = counted(tmp_path, [part], [Ended(130, True, 2.0)])
    assert found == {
        "frames": {"part0": 0},
        "collecting_seconds": 2.0,
        "incomplete": {},
        "frames_per_second": None,
        "whole_frames_per_second": 0.0,
        "recording_was_stopped": True,
    }


def test_a_collection_that_lost_rounds_is_used_and_one_without_rounds_fails(
    tmp_path: Path,
) -> None:
    """A collection without PyBullet loses the rounds in which a car touched something."""
    whole, empty = train_collections(REHEARSAL, 2, 8)[:2]
    (tmp_path / whole.name).mkdir()
    write_dataset(tmp_path / whole.name)
    for each in (whole, empty):
        (tmp_path / f"{each.name}.log").write_text(
            "error: round r3 failed: contacts need PyBullet\n"
        )
    ended = [Ended(1, False, 4.0), Ended(1, False, 2.0)]
    commands = [each.command(tmp_path) for each in (whole, empty)]
    found = counted(tmp_path, [whole, empty], ended)
    assert found["frames"][whole.name] > 0
    assert found["frames_per_second"] is None
    assert found["incomplete"][whole.name] == ["error: round r3 failed: contacts need PyBullet"]
    stages.require_recorded([whole], commands[:1], ended[:1], found)
    with pytest.raises(stages.StageFailed, match="contacts need PyBullet"):
        stages.require_recorded([whole, empty], commands, ended, found)
