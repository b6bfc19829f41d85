"""Publishes the newest checkpoint of a stopped training as a model; prints its step number.

    python -m benchmarks.gpu.publish_checkpoint RUN

The model has no uncertainty head. `mtlnet ship --data` can fit an uncertainty head later, on other
rounds and on any machine.
"""

import sys
from pathlib import Path

from safetensors import safe_open

from mtlnet.architecture import HEIGHT, WIDTH, find_architecture
from mtlnet.export.publish import Provenance, publish
from mtlnet.inference.golden_image import golden_image
from mtlnet.model.network import Network
from mtlnet.training.checkpoint import list_checkpoints
from mtlnet.training.configure import read_config
from mtlnet.training.recipes import find_recipe
from trackfeatures.errors import UserError

PREFIX, UNITS = "network.", "units."


def publish_checkpoint(run: Path) -> int:
    """Publish the model of the newest checkpoint in the folder `run`; return its step number.

    Raises UserError if there is no checkpoint.
    """
    config, about = read_config(run)
    checkpoints = list_checkpoints(run)
    if not checkpoints:
        raise UserError(f"{run} has no checkpoint; train again")
    with safe_open(checkpoints[-1], framework="pt") as file:
        step = int(file.metadata()["step"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 no dict
    weights, units = (
        {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
        for prefix in (PREFIX, UNITS)
    )
    recipe = find_recipe(config.recipe)
    network = Network(
        batch_norm=recipe.batch_norm,
        dropout=recipe.dropout,
        architecture=find_architecture(config.network),
    )
    network.load_state_dict(weights)
    for name, unit in units.items():
        network.get_buffer(name).copy_(unit)
    provenance = Provenance(
        alpha=config.alpha,
        recipe=config.recipe,
        iterations=step,
        batch=config.batch,
        seed=config.seed,
        data=about,
    )
    publish(network, run, golden_image(WIDTH, HEIGHT)[None], provenance)
    return step


if __name__ == "__main__":
    print(publish_checkpoint(Path(sys.argv[1])))
