"""Processor time of a replayed frame of quartz16, for `stage_cost.py`: prints pairs of microseconds as JSON."""

import json
import sys
import time
from pathlib import Path

import older_names
from stage_cost_parts import RECORDED_S, reference_us

ROUNDS = 5


def main(folder: Path) -> None:
    older_names.provide()
    from replay_speed import open_replay, record

    path = record(folder, RECORDED_S)
    samples = []
    for _ in range(ROUNDS):
        loop_us = reference_us()
        begun_s = time.process_time()
        with open_replay(path) as replaying:
            for _moment in replaying.moments():
                pass
            frames = replaying.counters.frames
        samples.append(((time.process_time() - begun_s) / frames * 1e6, (loop_us + reference_us()) / 2))
    print(json.dumps({"replay of quartz16, bytes to messages": samples}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
