"""Directory of a LeRobotDataset 3.0, to which recordings are added one by one; valid after each of them."""

import fcntl
import io
import json
import math
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import MissingLibraryError
from resonator_daemon.base.host.files import NewFile, NoNewFileError, replace_file
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.extensions.lerobot.features import SINGLES, Values

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise MissingLibraryError(f"datasets for LeRobot need pyarrow: {how_to_install('pyarrow')}") from error

INFO_FILE: Final = "meta/info.json"
_DATA, _EPISODES = "data", "meta/episodes"
_PLACE: Final = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FILES_PER_CHUNK: Final = 1000
_LIMITS: Final = {"chunks_size": _FILES_PER_CHUNK, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
_STATISTICS: Final = ("min", "max", "mean", "std")  # and the count of known values: rows of arrays (5, ...)
_KNOWN: Final = "known"  # column of an episode: how many values of each element are
_TASK: Final = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"}
_FOR_PANDAS: Final = json.dumps({"index_columns": ["task"], "column_indexes": [], "columns": [_TASK]})
_BATCH_BYTES: Final = 1 << 20  # of numbers; Python holds them in ten times as much
_GAP_MAX_S: Final = 60.0


class Dataset:
    """A new or existing dataset, locked against other exports until `release`.

    Parameters
    ----------
    path
        Its directory: none, an empty one, or what an earlier export made.
    description
        What info.json of a new one states, as of `describe`.

    Attributes
    ----------
    info : dict
        Content of info.json; the totals may be those of earlier.
    episodes, frames : int
        Number of those that are complete.
    tasks : dict of str to int
        Index of each task.
    sources : set
        SHA-256 and span of each recording.

    Raises
    ------
    NoNewFileError
        Another export writes to the directory.
    """

    def __init__(self, path: Path, description: dict[str, Any]) -> None:
        self._path, self._is_new = path, not path.exists()
        path.mkdir(exist_ok=True)
        self._lock = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(self._lock)
            raise NoNewFileError(f"{path}: another export writes to it; repeat this when it has ended") from error
        paths = {"data_path": f"{_DATA}/{_PLACE}", "video_path": None}
        self.info: dict[str, Any] = {"codebase_version": "v3.0", **description, **_LIMITS, **paths}
        with suppress(FileNotFoundError):
            self.info = json.loads((path / INFO_FILE).read_text())
        self.episodes = self.frames = self._files = 0
        self.tasks: dict[str, int] = {}
        self.sources: set[tuple[str, str]] = set()
        self._statistics: dict[str, Floats] = {}
        for file in sorted(path.glob(f"{_EPISODES}/*/*.parquet")):
            self._count(pq.read_table(file).to_pylist())
        if self.episodes < self.info.get("total_episodes", 0):
            os.close(self._lock)
            raise NoNewFileError(f"{path}: files of {_EPISODES} are missing; restore them, or name another directory")

    @property
    def place(self) -> dict[str, int]:
        """Chunk and file of the next recording."""
        return {"chunk_index": self._files // _FILES_PER_CHUNK, "file_index": self._files % _FILES_PER_CHUNK}

    def new_file(self) -> NewFile:
        """Return the data file of the next recording, instead of one that a killed export left."""
        path = self._path / _DATA / _PLACE.format(**self.place)
        path.parent.mkdir(parents=True, exist_ok=True)
        for left in path.parent.glob(f"{path.name}*"):
            left.unlink()
        return NewFile(path)

    def add(self, episodes: list[dict[str, Any]]) -> None:
        """Add a recording whose data file is complete: from now on it is part of the dataset."""
        self._write_table(f"{_EPISODES}/{_PLACE.format(**self.place)}", pa.Table.from_pylist(episodes))
        self._count(episodes)

    def publish(self) -> None:
        """Write the files about the whole dataset."""
        tasks = {"task_index": [*self.tasks.values()], "task": [*self.tasks]}
        self._write_table("meta/tasks.parquet", pa.table(tasks, metadata={"pandas": _FOR_PANDAS}))
        statistics = {key: _stored(np.nan_to_num(one)) for key, one in self._statistics.items()}
        replace_file(self._path / "meta/stats.json", json.dumps(statistics).encode())
        totals = {"total_episodes": self.episodes, "total_frames": self.frames, "total_tasks": len(self.tasks)}
        info = self.info | totals | {"splits": {"train": f"0:{self.episodes}"}}
        replace_file(self._path / INFO_FILE, json.dumps(info, indent=2).encode())

    def release(self) -> None:
        """Release the lock; remove a directory that was made for nothing."""
        if self._is_new and not self.episodes:
            shutil.rmtree(self._path)
        os.close(self._lock)

    def _count(self, episodes: list[dict[str, Any]]) -> None:
        """Count the episodes of one file."""
        self._files += 1
        self.episodes += len(episodes)
        for row in episodes:
            self.frames += row["length"]
            self.tasks.setdefault(row["tasks"][0], len(self.tasks))
            self.sources.add((row["source_sha256"], row["span"]))
            for key in self.info["features"]:
                names = [*(f"stats/{key}/{name}" for name in _STATISTICS), f"{_KNOWN}/{key}"]
                _merge(self._statistics, key, np.array([row[name] for name in names], float))

    def _write_table(self, name: str, table: Any) -> None:
        content = io.BytesIO()
        pq.write_table(table, content)
        replace_file(self._path / name, content.getvalue())


class RecordingWriter:
    """Adds one recording to a dataset: frames in batches, and episodes with their statistics.

    Parameters
    ----------
    dataset
    source
        Metadata of the recording.
    """

    def __init__(self, dataset: Dataset, source: dict[str, str]) -> None:
        self._dataset, self._source = dataset, source
        self._shapes = {key: one["shape"] for key, one in dataset.info["features"].items() if key not in SINGLES}
        self._batch_rows = max(1, _BATCH_BYTES // (4 * sum(map(math.prod, self._shapes.values()))))
        self._file: NewFile | None = None
        self._parquet: Any = None
        self._tasks = dict(dataset.tasks)
        self._episodes: list[dict[str, Any]] = []
        self._waiting: list[tuple[int, Values]] = []
        self._fps: float = dataset.info["fps"]
        self._task: str | None = None
        self._last_s: float | None = None
        self._statistics: dict[str, Floats] = {}
        self._begin = self._end = dataset.frames  # of the episode, as written
        self._episode = dataset.episodes

    def add(self, t_ns: int, board_s: float, values: Values) -> None:
        """Add a frame to the episode, if there is one, and masked frames for those that are missing before it.

        What has no value is unknown. After a gap of more than 60 s by the board's time, or a restart of the board, the
        frame begins another episode.
        """
        if self._task is None:
            return
        gap_s = 0.0 if self._last_s is None else board_s - self._last_s
        if not 0.0 <= gap_s <= _GAP_MAX_S:
            self.begin_episode(self._task)
            gap_s = 0.0
        for missing in range(max(0, round(gap_s * self._fps) - 1), -1, -1):
            self._waiting.append((t_ns - round(missing * 1e9 / self._fps), {} if missing else values))
            if len(self._waiting) >= self._batch_rows:
                self._flush()
        self._last_s = board_s

    def begin_episode(self, task: str | None) -> None:
        """End the present episode, which exists if it has frames, and begin another one; None: none."""
        self._flush()
        if self._end > self._begin:
            span = {"dataset_from_index": self._begin, "dataset_to_index": self._end, "length": self._end - self._begin}
            row = span | {"episode_index": self._episode, "tasks": [self._task]}
            for folder in (_DATA, _EPISODES):
                row |= {f"{folder}/{key}": at for key, at in self._dataset.place.items()}
            for key, statistics in self._statistics.items():
                row |= {f"stats/{key}/{name}": part for name, part in _stored(statistics).items()}
                row[f"{_KNOWN}/{key}"] = statistics[-1].tolist()
            self._episodes.append(row | {key: self._source[key] for key in ("source", "source_sha256", "span")})
        self._task, self._last_s, self._statistics, self._begin = task, None, {}, self._end
        self._episode = self._dataset.episodes + len(self._episodes)

    def finish(self) -> dict[str, int]:
        """Add the recording to the dataset; return the number of its episodes and frames, nothing if it has none."""
        self.begin_episode(None)
        if self._file is None:
            return {}
        self._parquet.close()
        self._file.keep()
        self._dataset.add(self._episodes)
        return {"episodes": len(self._episodes), "frames": sum(row["length"] for row in self._episodes)}

    def discard(self) -> None:
        """Remove what was written of a recording that is not part of the dataset."""
        if self._file is not None:
            with suppress(OSError, AttributeError):  # it would try when it is collected, and have no file
                self._parquet.close()
            self._file.discard()

    def _flush(self) -> None:
        """Write the frames that wait as a row group."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        count = len(waiting)
        columns: dict[str, NDArray[Any]] = {}
        for key, shape in self._shapes.items():
            columns[key] = np.full((count, *shape), np.nan, np.float32)
            for row, (_, values) in zip(columns[key], waiting, strict=True):
                row[...] = values.get(key, np.nan)
        index = np.arange(self._end, self._end + count)
        frame = index - self._begin
        task = self._tasks.setdefault(self._task or "", len(self._tasks))
        valid = np.isfinite(next(iter(columns.values()))).reshape(count, -1).all(axis=1)
        singles = (valid, [t_ns for t_ns, _ in waiting], frame / self._fps, frame, self._episode, index, task)
        for (key, kind), values in zip(SINGLES.items(), singles, strict=True):
            columns[key] = np.array(np.broadcast_to(values, count), kind)[:, np.newaxis]
        for key, column in columns.items():
            known = column.astype(float)
            _merge(self._statistics, key, _merged(known, known, known, np.zeros_like(known), np.isfinite(known)))
        table = pa.Table.from_arrays([_arrow(column) for column in columns.values()], [*columns], metadata=self._source)
        if self._file is None:
            self._file = self._dataset.new_file()
            self._parquet = pq.ParquetWriter(self._file.file, table.schema, compression="zstd")
        self._parquet.write_table(table)
        self._end += count


def _arrow(column: NDArray[Any]) -> Any:
    """Return values (n, ...) as LeRobot's loader expects them: single ones, or nested lists of fixed sizes."""
    array, shape = pa.array(column.ravel()), column.shape[1:]
    for size in reversed(shape if shape != (1,) else ()):
        array = pa.FixedSizeListArray.from_arrays(array, size)
    return array


def _merge(statistics: dict[str, Floats], key: str, more: Floats) -> None:
    """Add the statistics of further values of a feature."""
    parts = [statistics[key], more] if key in statistics else [more]
    statistics[key] = _merged(*np.stack(parts, axis=1))


def _merged(low: Floats, high: Floats, means: Floats, stds: Floats, counts: NDArray[Any]) -> Floats:
    """Return the statistics of the values of several parts, along the first axis."""
    count = counts.sum(axis=0)
    with np.errstate(invalid="ignore"):
        mean = np.nansum(means * counts, axis=0) / count
        variance = np.nansum((stds**2 + (means - mean) ** 2) * counts, axis=0) / count
    return np.array([np.fmin.reduce(low), np.fmax.reduce(high), mean, np.sqrt(variance), count])


def _stored(statistics: Floats) -> dict[str, list[Any]]:
    """Return statistics as LeRobot stores them, with one count for each feature."""
    return dict(zip(_STATISTICS, statistics.tolist(), strict=False)) | {"count": [int(statistics[-1].max())]}
