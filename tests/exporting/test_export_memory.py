"""An export takes as much memory of a long recording as of a short one."""

import subprocess
import sys
from pathlib import Path

PROGRAM = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from export_bench import METADATA, played
from resonator_daemon.exporting import table_output
from resonator_daemon.exporting.csv_file import CsvFormat
from resonator_daemon.exporting.mcap_file import McapOutput
from resonator_daemon.exporting.npz_file import NpzFormat
from resonator_daemon.exporting.parquet_file import ParquetFormat
from resonator_daemon.exporting.ros2_file import Ros2Output
from resonator_daemon.exporting.table_output import TableOutput
from resonator_daemon.exporting.target import TOPICS

table_output._BATCH_BYTES = 100_000
folder, case = Path(sys.argv[2]), played("touches")
plate = case.config.plate

def outputs(turn):
    place = lambda end: lambda topic: folder / f"{turn}-{topic.replace('/', '-')}{end}"
    yield TableOutput(ParquetFormat(place(".parquet"), METADATA), TOPICS["parquet"], plate)
    yield TableOutput(CsvFormat(place(".csv")), TOPICS["csv"], plate)
    yield TableOutput(NpzFormat(folder / f"{turn}.npz", METADATA), TOPICS["npz"], plate)
    yield McapOutput(folder / f"{turn}.mcap", TOPICS["mcap"], plate, "left", METADATA, {})
    yield Ros2Output(folder / f"{turn}-ros.mcap", TOPICS["ros2"], plate, "left", METADATA)

for turn, times in ((1, 2), (2, 8)):
    for output in outputs(turn):
        for _ in range(times):
            for moment in case.moments:
                output.take(moment)
        output.close()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_four_times_the_messages_take_no_more_memory(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(Path(__file__).parent), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    short_kb, long_kb = map(int, done.stdout.split())
    assert long_kb < 1.1 * short_kb
    assert (tmp_path / "2-forces.csv").stat().st_size > 3.9 * (tmp_path / "1-forces.csv").stat().st_size
