"""README.md of an export: contents, source dataset, and how to read it."""

from datagen.export.split_sides import Side
from datagen.recording.dataset import Dataset
from runtime.cli import counted

WEBDATASET = """---
license: mit
---
# {name}, as WebDataset shards

{counts}
of the driverview dataset `{name}`, content hash
`{hash}`.
`KEY.jpg` is the recorded image byte for byte (`KEY.png` where it was recorded without loss),
`KEY.json` the labels (null: absent), the car's state and the driver's command of the same time.
`sample.schema.json` describes unit, frame, sign and meaning of every value.
A round is in one side of the split only. Frames of a round are similar: shuffle across shards.

```python
import webdataset as wds

urls = "{first}-{{000000..{last:06d}}}.tar"
for image, about in wds.WebDataset(urls, shardshuffle=False).decode("rgb8").to_tuple("jpg", "json"):
    print(image.shape, about["labels"]["to_lane_centre"])  # m, left positive
```
"""

LEROBOT = """---
license: mit
task_categories:
- robotics
tags:
- LeRobot
configs:
- config_name: default
  data_files: data/*/*.parquet
---
# {name}, as a LeRobotDataset v3.0

{counts}
of the driverview dataset `{name}`, content hash
`{hash}`.
An episode is a round; images are the recorded bytes. `observation.state`: vx, vy (m/s, body frame,
left positive), yaw_rate (rad/s, counter-clockwise). `action`: steer in [-1, 1], left positive,
throttle, brake, gear. `labels`: distances in m (NaN: absent), angle in rad, heading 0 left,
1 straight, 2 right, and where the car is on the road; `pose`: x, y, z (m), yaw, pitch, roll
(rad). Names are in `meta/info.json`, with the episodes of each side under `splits`; unit, frame and
meaning of every value are in the dataset's `schemas/driverview.schema.json`.

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("driverview/{name}", root=".")
print(dataset[0]["observation.images.front"].shape, dataset[0]["labels"])
```
"""
CARDS = {"webdataset": WEBDATASET, "lerobot": LEROBOT}


def card(dataset: Dataset, parts: list[Side], kind: str, shard_size: int) -> str:
    """Markdown with the front matter for Hugging Face."""
    counts = ", ".join(
        f"{side.name} {counted(side.frames, 'frame')} of {counted(len(side.rounds), 'round')}"
        for side in parts
    )
    return CARDS[kind].format(
        name=dataset.path.resolve().name,
        counts=counts[0].upper() + counts[1:],
        hash=dataset.content_hash,
        first=parts[0].name,
        last=(parts[0].frames - 1) // shard_size,
    )
