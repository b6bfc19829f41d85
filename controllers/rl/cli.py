"""The command `controllers train`. Run: `controllers train --algorithm td3 --track forza`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from controllers.rl.config import ALGORITHMS, TrainConfig
from runtime import cli as command

DEFAULT = TrainConfig()

AlgorithmName = Annotated[str, typer.Option(help=f"{' or '.join(ALGORITHMS)}.")]
Track = Annotated[str, typer.Option(help="Its name (`simulator tracks`) or file.")]
Seed = Annotated[int, typer.Option(help="Fixes the whole training.", min=0)]
Out = Annotated[Path, typer.Option(help="Folder for the actor, its curve and its checkpoint.")]
Steps = Annotated[int, typer.Option(help="Control steps of 50 ms, with one update each.", min=1)]
State = Annotated[str, typer.Option(help="What the actor sees: paper, stacked or residual.")]
Noise = Annotated[
    float | None,
    typer.Option(help="Standard deviation of the noise on the state [default: the algorithm's]"),
]
Rate = Annotated[float | None, typer.Option(help="Learning rate [default: the algorithm's]")]
Reward = Annotated[str, typer.Option(help="paper, or quadratic: the paper's second reward.")]
Every = Annotated[int, typer.Option(help="Steps between two drives, and checkpoints.", min=1)]
TracksDir = Annotated[Path | None, typer.Option(help="Folder of TORCS tracks.")]


def train(
    algorithm: AlgorithmName = DEFAULT.algorithm,
    track: Track = DEFAULT.track,
    seed: Seed = DEFAULT.seed,
    out: Out = DEFAULT.out,
    steps: Steps = DEFAULT.steps,
    state: State = DEFAULT.state,
    state_noise: Noise = DEFAULT.state_noise,
    actor_rate: Rate = DEFAULT.actor_rate,
    critic_rate: Rate = DEFAULT.critic_rate,
    reward: Reward = DEFAULT.reward,
    evaluate_every: Every = DEFAULT.evaluate_every,
    tracks_dir: TracksDir = DEFAULT.tracks_dir,
    as_json: command.AsJson = False,
) -> None:
    """Train an actor to steer by reinforcement learning; drive it with `--controller OUT`.

    Every so many steps the present actor drives the track without noise; the best one is kept. The
    same command continues a training that was stopped.
    """
    config = TrainConfig(
        out=out,
        algorithm=algorithm,
        track=track,
        seed=seed,
        steps=steps,
        state=state,
        state_noise=state_noise,
        actor_rate=actor_rate,
        critic_rate=critic_rate,
        reward=reward,
        evaluate_every=evaluate_every,
        tracks_dir=tracks_dir,
    )
    result = _train_with_progress(config)
    line = (
        f"best {reward} reward a step on {track}: {result['best_score_per_step']:.4f} at step "
        f"{result['best_step']}; drive it with: controllers drive --controller {out}"
    )
    command.print_result(result, as_json, line)


def _train_with_progress(config: TrainConfig) -> dict[str, Any]:
    from rich.markup import escape

    from controllers.rl.training import train as train_actor

    name = escape(f"{config.algorithm} on {config.track}")
    with command.progress_bar() as bar:
        task = bar.add_task(name, total=config.steps)

        def report(step: int, best: float) -> None:
            shown = f"{name}, best {best:.4f}" if best > float("-inf") else name
            bar.update(task, completed=step, description=shown)

        return train_actor(config, report)
