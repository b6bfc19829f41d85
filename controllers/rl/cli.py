"""The command `controllers train`. Run: `controllers train --algorithm td3 --track forza`."""

from collections.abc import Container
from dataclasses import fields, replace

from controllers.cli_options import options_and_given
from controllers.rl.config import TrainConfig, resolve
from runtime import cli as command
from trackfeatures.errors import UserError


@options_and_given(TrainConfig)
def train(config: TrainConfig, as_json: bool, given: Container[str]) -> None:
    """Train an actor, a network that computes the steering, by reinforcement learning.

    At intervals (--evaluate-every) the present actor is evaluated in drives without exploration
    noise; the actor with the highest reward is kept. `controllers drive --controller OUT` drives
    with it. To continue an interrupted training, run the same command again, or with
    --resume. "The paper" is Li et al., "Reinforcement Learning and Deep Learning based Lateral
    Control for Autonomous Driving".
    """
    from rich.markup import escape

    from controllers.rl.training import train as run

    config = _continued(config, given) if config.resume else resolve(config)
    name = escape(f"{config.algorithm} on {config.track}")
    with command.progress_bar() as bar:
        task = bar.add_task(name, total=config.steps)

        def report(step: int, best: float) -> None:
            shown = f"{name}, best {best:.4f}" if best > float("-inf") else name
            bar.update(task, completed=step, description=shown)

        result = run(config, report)
    line = (
        f"best {config.reward} reward per step on {config.track}: "
        f"{result['best_score_per_step']:.4f} at step {result['best_step']}; drive it with: "
        f"controllers drive --controller {config.out}"
    )
    command.print_result(result, as_json, line)


def _continued(config: TrainConfig, given: Container[str]) -> TrainConfig:
    """Return the options stored in the folder `config.out`; a given number of threads replaces the
    stored one.

    `given`: names of the options that the user has given. Raises UserError if another of these
    options differs from the stored option.
    """
    from controllers.rl.run_folder import UNCOMPARED, stored_config

    stored = stored_config(config.out)
    for field in fields(TrainConfig):
        name, value = field.name, getattr(config, field.name)
        if name in given and name not in UNCOMPARED and value != getattr(stored, name):
            raise UserError(
                f"{config.out} was started with {name} {getattr(stored, name)}, now {value} is "
                "given; leave it out to continue, or start another training with another --out"
            )
    return replace(stored, threads=config.threads) if "threads" in given else stored
