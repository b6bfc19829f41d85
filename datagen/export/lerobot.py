"""Writes a dataset as a LeRobotDataset v3.0: an episode is a round; images in parquet files.

The frames of an episode have a constant rate. Each part of a recovered round without missing frames
is an episode of its own.
LeRobotDataset("driverview/data", root=OUT) reads it. Image bytes are copied as recorded. Episodes
are sorted by side (train, test, unseen); `splits` in meta/info.json has the episodes of each side.
Source of the format: github.com/huggingface/lerobot, datasets/lerobot_dataset.py and utils.py.
"""

import json
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from datagen.export.lerobot_features import IMAGE, Columns, columns, features, table
from datagen.export.lerobot_stats import Histogram, Stats, column_stats
from datagen.export.split_sides import Progress, Side
from datagen.recording.errors import DatasetError
from datagen.recording.names import PLACED
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.schema.topics import CAMERA, steps_at
from datagen.view.steps import Step, Steps
from runtime.files import write_json
from trackfeatures.camera import CameraParameters

VERSION = "v3.0"
CHUNK_FILES = 1000
FILE_MB = 100
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
INDEX_NAME = "__index_level_0__"


def write(folder: Path, parts: list[Side], camera: CameraParameters, progress: Progress) -> None:
    """Write all rounds of the sides `parts` into `folder`. `camera` gives the size of the images.
    `progress` is called with the number of frames written so far. Raises DatasetError if rounds
    have different frame rates."""
    rounds = [info for side in parts for info in side.rounds]
    tasks = sorted({_task(info) for info in rounds})
    with _DataFiles(folder) as files:
        writer = _Episodes(files, camera, tasks)
        for info in rounds:
            writer.add(info, Steps.open(info.path))
            progress(writer.frames)
    _write_tasks(folder / "meta/tasks.parquet", tasks)
    (folder / EPISODES_FILE).parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(writer.rows), folder / EPISODES_FILE)
    write_json(folder / "meta/stats.json", writer.stats())
    write_json(folder / "meta/info.json", _info(writer, parts, tasks, camera))


def _task(info: RoundInfo) -> str:
    if info.trajectory == PLACED:
        return "no drive: the car stands at another pose in each frame"
    return f"drive, trajectory: {info.trajectory}"


class _DataFiles:
    """Writes data/chunk-000/file-000.parquet and so on: files of at most about `FILE_MB` MiB, with
    one row group per episode."""

    def __init__(self, folder: Path) -> None:
        self.place = (0, 0)  # numbers of the chunk and of the file in it
        self._folder, self._bytes = folder, 0
        self._writer: pq.ParquetWriter | None = None

    def add(self, episode: pa.Table) -> None:
        if self._writer is None or self._bytes + episode.nbytes > FILE_MB << 20:
            self._next(episode.schema)
        assert self._writer is not None
        self._writer.write_table(episode, row_group_size=len(episode))
        self._bytes += episode.nbytes

    def _next(self, schema: pa.Schema) -> None:
        if self._writer is not None:
            self._writer.close()
            number = self.place[0] * CHUNK_FILES + self.place[1] + 1
            self.place = divmod(number, CHUNK_FILES)
        chunk, file = self.place
        path = self._folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = pq.ParquetWriter(path, schema, use_dictionary=False)
        self._bytes = 0

    def __enter__(self) -> "_DataFiles":
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None:
            self._writer.close()


class _Episodes:
    """Writes rounds one at a time, and collects the rows of meta/episodes and the statistics of the
    dataset."""

    def __init__(self, files: _DataFiles, camera: CameraParameters, tasks: list[str]) -> None:
        self.rows: list[dict[str, Any]] = []
        self.frames, self.fps = 0, 0
        self._files, self._camera, self._tasks = files, camera, tasks
        self._numbers: list[Columns] = []
        self._pixels = Histogram()

    def add(self, info: RoundInfo, round_steps: Steps) -> None:
        header = round_steps.index.header
        if self.fps not in (0, header.frequency_hz):
            raise DatasetError(
                f"{info.path} has {header.frequency_hz} frames a second, the rounds before it "
                f"{self.fps}: LeRobot supports one rate a dataset; export them separately"
            )
        self.fps = header.frequency_hz
        steps = list(round_steps)
        places = steps_at(round_steps.index.log_times(CAMERA), self.fps)
        ends = [*(np.flatnonzero(np.diff(places) != 1) + 1).tolist(), len(steps)]
        for start, end in pairwise([0, *ends]):
            self._add_episode(info, header.codec, steps[start:end])

    def _add_episode(self, info: RoundInfo, codec: str, steps: list[Step]) -> None:
        """Write an episode: consecutive frames `steps` of the round `info`."""
        task = self._tasks.index(_task(info))
        numbers = columns(steps, self.fps, len(self.rows), self.frames, task)
        self._files.add(table(steps, numbers, codec))
        self._add_row(info, numbers, self._count_pixels(info, steps))

    def stats(self) -> dict[str, Stats]:
        names = self._numbers[0]
        whole = {name: np.concatenate([part[name] for part in self._numbers]) for name in names}
        return {IMAGE: self._pixels.stats(), **column_stats(whole)}

    def _count_pixels(self, info: RoundInfo, steps: list[Step]) -> Stats:
        try:
            pixels = Histogram.of(steps, self._camera)
        except ValueError as error:
            raise DatasetError(
                f"{info.path}: an image cannot be read ({error}); run `datagen verify --level "
                "deep` on the dataset and record the round again"
            ) from error
        self._pixels.add(pixels)
        return pixels.stats()

    def _add_row(self, info: RoundInfo, numbers: Columns, pixels: Stats) -> None:
        chunk, file = self._files.place
        count = len(numbers["index"])
        stats = {IMAGE: pixels, **column_stats(numbers)}
        self.rows.append(
            {
                "episode_index": len(self.rows),
                "tasks": [_task(info)],
                "length": count,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                "round": info.id,
                "track": info.track,
                "light": ", ".join(info.lights),
                **{
                    f"stats/{f}/{kind}": v
                    for f, kinds in stats.items()
                    for kind, v in kinds.items()
                },
            }
        )
        self.frames += count
        self._numbers.append(numbers)


def _write_tasks(path: Path, tasks: list[str]) -> None:
    """Write the tasks as a pandas table to a parquet file: the index is the text of the task."""
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {
        "index_columns": [INDEX_NAME],
        "column_indexes": [],
        "columns": [
            _pandas_column("task_index", "task_index", "int64", "int64"),
            _pandas_column(None, INDEX_NAME, "object", "unicode"),
        ],
        "pandas_version": "2.0.0",
    }
    content = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), INDEX_NAME: tasks})
    pq.write_table(content.replace_schema_metadata({"pandas": json.dumps(about)}), path)


def _pandas_column(name: str | None, field: str, numpy_type: str, kind: str) -> dict[str, Any]:
    return {
        "name": name,
        "field_name": field,
        "numpy_type": numpy_type,
        "pandas_type": kind,
        "metadata": None,
    }


def _info(
    writer: _Episodes, parts: list[Side], tasks: list[str], camera: CameraParameters
) -> dict[str, Any]:
    ids = [{info.id for info in side.rounds} for side in parts]
    counts = (sum(row["round"] in of_side for row in writer.rows) for of_side in ids)
    ends = list(accumulate(counts, initial=0))
    return {
        "codebase_version": VERSION,
        "robot_type": "driverview",
        "total_episodes": len(writer.rows),
        "total_frames": writer.frames,
        "total_tasks": len(tasks),
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": writer.fps,
        "splits": {side.name: f"{ends[i]}:{ends[i + 1]}" for i, side in enumerate(parts)},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features(camera),
    }
