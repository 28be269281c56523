"""Short runs of the commands of `make soak` and `make fuzz`, with few faults."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.parametrize(
    "command",
    [
        "kills.py hang-ups --count 1",
        "kills.py orders --count 1",
        "kills.py recorders --count 1",
        "power_failure.py --seconds 0 --moments 10",
        "year.py --days 2 --seed 3",
        "wire_accounts.py 10000",
        "fuzz.py wire --inputs 2000",
        "fuzz.py commands --inputs 5000",
    ],
)
def test_a_short_run_of_each_command_meets_its_requirements(command: str) -> None:
    name, *words = command.split()
    run = subprocess.run([sys.executable, BENCHMARKS / name, *words], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
