"""Instructions of one frame of each stage, counted by valgrind: they repeat within a percent on a busy computer, too.

`stages.py` runs this program under callgrind with a directory for its files; it prints JSON.
"""

import json
import os
import pickle
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

import stages_force
import stages_system
from stage_measure import Work

FILE = "counted"
SKIN = "skin.pickle"


def counts_of_all(skin: dict[str, Work]) -> dict[str, float]:
    """Return the instructions of one frame by stage; works of a skin come set up, for which valgrind needs minutes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / SKIN).write_bytes(pickle.dumps(skin))
        valgrind = ["valgrind", "--quiet", "--tool=callgrind", "--instr-atstart=no"]
        command = [*valgrind, f"--callgrind-out-file={folder / FILE}", sys.executable, __file__, name]
        fixed = os.environ | {"PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1"}
        run = subprocess.run(command, env=fixed, stdout=subprocess.PIPE, text=True, check=True)
        counts: dict[str, float] = json.loads(run.stdout.splitlines()[-1])
        return counts | {"start of the daemon": stages_system.start_instructions(folder)}


def counted(run: Callable[[], object], folder: Path) -> int:
    """Return the instructions of a call and of the orders around it."""
    _control("--zero")
    _control("--instr=on")
    run()
    _control("--instr=off")
    before = set(folder.glob(f"{FILE}.*"))
    _control("--dump")
    (made,) = set(folder.glob(f"{FILE}.*")) - before
    found = re.search(r"^totals: (\d+)", made.read_text(), re.MULTILINE)
    assert found is not None  # noqa: S101 - callgrind writes it
    made.unlink()
    return int(found[1])


def _control(option: str) -> None:
    """Control callgrind, which runs this process."""
    subprocess.run(
        ["callgrind_control", option, str(os.getpid())],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )


def main(folder: Path) -> None:
    empty = counted(lambda: None, folder)
    counts: dict[str, float] = {}
    with ExitStack() as stack:
        stages = chain(stages_force.stages(), stages_system.stages(stack, folder))  # each is set up when its turn comes
        works = ((stage.name, stage.ours) for stage in stages)
        for name, work in chain(works, pickle.loads((folder / SKIN).read_bytes()).items()):
            work.run()  # warms up
            counts[name] = round((counted(work.run, folder) - empty) / work.frames)
            print(f"counted: {name}", file=sys.stderr, flush=True)
    print(json.dumps(counts))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
