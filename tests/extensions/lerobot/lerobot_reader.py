"""Read a dataset with LeRobot's own loader, and print what it has as JSON; runs in the environment of LeRobot.

Every frame is taken by its index, and each episode is also loaded alone, with the frames one step before.
"""

import json
import sys

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

root = sys.argv[1]
dataset = LeRobotDataset("resonatord/test", root=root)
frames = [dataset[number] for number in range(len(dataset))]
columns = {
    key: np.stack([np.asarray(frame[key]) for frame in frames]).reshape(len(frames), -1).tolist()
    for key in dataset.features
}
steps = {"t_ns": [-1 / dataset.fps, 0.0]}
previous = []
for episode in range(dataset.num_episodes):
    alone = LeRobotDataset("resonatord/test", root=root, episodes=[episode], delta_timestamps=steps)
    previous.append([alone[number]["t_ns"].tolist() for number in range(len(alone))])
assert dataset.meta.stats.keys() == dataset.features.keys()
tasks = [frame["task"] for frame in frames]
json.dump({"tasks": tasks, "columns": columns, "previous": previous}, sys.stdout)
