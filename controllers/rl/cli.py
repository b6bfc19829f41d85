"""The command `controllers train`. Run: `controllers train --algorithm td3 --track forza`."""

from controllers.cli_options import options
from controllers.rl.config import TrainConfig
from runtime import cli as command


@options(TrainConfig)
def train(config: TrainConfig, as_json: bool) -> None:
    """Train an actor to steer by reinforcement learning; drive it with `--controller OUT`.

    Every --evaluate-every steps the present actor drives the track without noise, and the best
    actor is kept. The same command continues an interrupted training.
    """
    from rich.markup import escape

    from controllers.rl.training import train as run

    name = escape(f"{config.algorithm} on {config.track}")
    with command.progress_bar() as bar:
        task = bar.add_task(name, total=config.steps)

        def report(step: int, best: float) -> None:
            shown = f"{name}, best {best:.4f}" if best > float("-inf") else name
            bar.update(task, completed=step, description=shown)

        result = run(config, report)
    line = (
        f"best {config.reward} reward a step on {config.track}: "
        f"{result['best_score_per_step']:.4f} at step {result['best_step']}; drive it with: "
        f"controllers drive --controller {config.out}"
    )
    command.print_result(result, as_json, line)
