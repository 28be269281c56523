"""How many times faster than real time a recording becomes messages, on one core, and whether always the same ones.

Run it with `python benchmarks/replay_speed.py [SECONDS [RUNS]]` (60 and 10): it records quartz16 as emulated, at full
rate with touches, and replays that; `python benchmarks/replay_speed.py FILE [RUNS]` replays a recording that is there.
Speeds are by processor time, which other work on the machine lengthens less than it does the clock's.
"""

import hashlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from resonator_daemon.replay.outputs import line
from resonator_daemon.replay.source import open_replay

ASKED = 20.0  # times real time
COMMAND = (str(Path(sys.executable).with_name("resonatord")),)


def record(folder: Path, seconds: float) -> Path:
    port, config, output = folder / "board", folder / "board.toml", folder / "run.mcap"
    config.write_text(f'plate = "quartz16"\nlink = "serial:{port}?baud=4000000"\n')
    emulator = subprocess.Popen([*COMMAND, "emulate", "--plate", "quartz16", "--pty", str(port), "--scenario", "real"])
    try:
        asked = [*COMMAND, "record", "--config", str(config), "--output", str(output), "--seconds", str(seconds)]
        subprocess.run(asked, check=True)
    finally:
        emulator.terminate()
        emulator.wait()
    return output


def replay(path: Path) -> tuple[float, float, int, str]:
    """Replay once, without output; return recorded and processor seconds, frames, and what became of it."""
    begun_s = time.process_time()
    first_ns = last_ns = 0
    with open_replay(path) as replaying:
        for moment in replaying.moments():
            first_ns, last_ns = first_ns or moment.now.monotonic_ns, moment.now.monotonic_ns
        frames = replaying.counters.frames
    took_s = time.process_time() - begun_s
    return (last_ns - first_ns) * 1e-9, took_s, frames, f"{replaying.differences} differences"


def main(arguments: list[str]) -> None:
    runs = int(arguments[1]) if len(arguments) > 1 else 10
    with tempfile.TemporaryDirectory() as folder:
        given = Path(arguments[0]) if arguments else None
        path = given if given is not None and given.is_file() else record(Path(folder), float((arguments or ["60"])[0]))
        speeds = []
        for _ in range(3):
            recorded_s, took_s, frames, differences = replay(path)
            speeds.append(recorded_s / took_s)
        digests = set()
        for _ in range(runs):
            with open_replay(path) as replaying:
                messages = (line(message) for moment in replaying.moments() for message in moment.messages)
                digests.add(hashlib.sha256("\n".join(messages).encode()).hexdigest())
    print(f"{path.name}: {recorded_s:.0f} s, {frames} frames, {differences}")
    print(f"{'figure':<44} {'asked':>8} {'seen':>8}")
    print(f"{'times real time, on one core (best of 3)':<44} {f'>= {ASKED:g}':>8} {max(speeds):8.1f}")
    print(f"{f'different outcomes of {runs} replays':<44} {'1':>8} {len(digests):8d}")


if __name__ == "__main__":
    main(sys.argv[1:])
