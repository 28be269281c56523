"""An export takes as much memory of a long recording as of a short one."""

import subprocess
import sys
from pathlib import Path

PROGRAM = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from export_bench import write
from resonator_daemon.tools.export import formats
from resonator_daemon.tools.export.output import TableOutput

TableOutput.batch_bytes = 100_000
folder = Path(sys.argv[2])

for turn, times in ((1, 2), (2, 8)):
    for form in formats():
        write(form, folder / f"{turn}-{form}.{form}", "touches", times=times)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_four_times_the_messages_take_no_more_memory(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(Path(__file__).parents[2] / "support"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    short_kb, long_kb = map(int, done.stdout.split())
    assert long_kb < 1.1 * short_kb
    assert (tmp_path / "2-csv-forces.csv").stat().st_size > 3.9 * (tmp_path / "1-csv-forces.csv").stat().st_size
