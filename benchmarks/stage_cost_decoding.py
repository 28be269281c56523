"""Processor time of decoded frames of skin32 by scene and stage, for `stage_cost.py`: prints pairs as JSON."""

import json

import older_names
from stage_cost_parts import reference_us
from threadpoolctl import threadpool_limits

FRAMES, SLICES = 120, 4
MEASURED = (
    "nothing",
    "sheared, sliding .03 mm a frame",
    "sheared, at rest",
    "pressed, no shear",
    "two contacts",
    "cold",
)
STAGES = ("map", "contacts", "rebuilds")


def main() -> None:
    older_names.provide()
    from frame_cost import SCENES, measure

    samples: dict[str, list[tuple[float, float]]] = {}
    for name in MEASURED:
        loop_us = reference_us()
        spent_ms, _ = measure(SCENES[name], FRAMES)
        loop_us = (loop_us + reference_us()) / 2
        whole = {f"decoding, {name}": spent_ms.sum(axis=1)}
        if name == "sheared, sliding .03 mm a frame":
            whole |= {f"  of which {stage}": spent_ms[:, number] for number, stage in enumerate(STAGES)}
        for stage, by_frame_ms in whole.items():
            parts = by_frame_ms.reshape(SLICES, -1).mean(axis=1) * 1e3
            samples[stage] = [(float(part_us), loop_us) for part_us in parts]
    print(json.dumps(samples))


if __name__ == "__main__":
    with threadpool_limits(1, user_api="blas"):
        main()
