"""Makes the corpus: short recordings of emulated boards with every fault, and the messages expected of each.

    .venv/bin/pytest tests/tools/replay/test_corpus_cases.py  # replay all recordings and compare; `-k skin`: those
    .venv/bin/python tests/corpus/make.py                # expectations again, of the recordings that are there
    .venv/bin/python tests/corpus/make.py record         # all recordings again, too; `record NAME...`: those alone

What is emulated follows from fixed seeds; when bytes arrive does not, so that each recording is another. Expectations
are what the present version makes of a recording: look at the differences before they are made again.
"""

import socket
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.board.config.tables import Measurement
from resonator_daemon.board.config.values import config_of, load_settings_text, plate_text, settings_text
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.switch import RecordingSwitch
from resonator_daemon.board.session.board_reader import BoardReader
from resonator_daemon.board.session.frames import BoardOnline
from resonator_daemon.measure.pipeline.control_requests import Control, SetWindow, Tare
from simulators.emulator import Emulator, EmulatorOptions
from simulators.faults import parse_faults

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from corpus_cases import CORPUS, EXPECTED_FILE, RECORDING_FILE, save_case, save_expected
from plates import small_skin
from scenarios import press_and_shear, touch_text

BOOT_ID: Final = "0123456789abcdef"
SETTINGS: Final = "[measurement]\nwindow_ms = 20\nstep_ms = 20\n[decoding]\n"


def touch(start_s: float, site: int, force_newton: float, hold_s: float = 0.6) -> str:
    return touch_text(start_s, force_newton, hold_s, site=site, rise_s=0.1, fall_s=0.1)


TOUCH: Final = touch(0.8, 7, 2.0)
PRESS_AND_SHEAR: Final = press_and_shear(2.0, 1.2)


@dataclass(frozen=True)
class Case:
    """A board in a scenario, with faults, for so long; `begin_s`: the recording begins that long after the board."""

    scenario: str
    faults: str = ""
    seconds: float = 2.2
    plate: str = "quartz16"
    begin_s: float = 0.0
    marked: bool = False
    orders: tuple[Control, ...] = ()  # one after the other


CASES: Final = {
    "touches": Case(touch(0.6, 7, 2.0) + touch(1.8, 3, 0.5) + touch(3.0, 16, 8.0), seconds=4.2, marked=True),
    "two-touches": Case(touch(0.6, 1, 1.0, 1.2) + touch(1.0, 11, 3.0, 0.4)),
    "slide": Case(TOUCH.replace("force_newton", "to_mm = [3.3, 3.5]\nforce_newton")),
    "overload": Case(touch(0.6, 5, 14.0)),
    "pressed-at-start": Case(touch(0.0, 9, 2.0, 1.2).replace("rise_s = 0.1", "rise_s = 0")),
    "temperature-drift": Case("environment_kelvin = [[0.6, 298.15], [0.7, 340.0]]\n" + TOUCH),
    "warm-finger": Case(TOUCH + "kelvin = 305.0\n"),
    "pilot-lost": Case("[plate]\npilot_level_db = -120.0\n" + TOUCH),
    "nothing-heard": Case("[plate]\nnoise_level_db = -62.0\n" + TOUCH),
    "bit-errors": Case(TOUCH, "bit_error_rate=1e-4"),
    "bursts-and-garbage": Case(TOUCH, "burst_rate_hz=5,garbage_rate_hz=5"),
    "lost-bytes": Case(TOUCH, "lost_chunk_rate_hz=4,lost_chunk_bytes=600"),
    "duplicates": Case(TOUCH, "duplicate_rate=0.1"),
    "reordered": Case(TOUCH, "reorder_rate=0.05"),
    "pieces-and-clumps": Case(TOUCH, "split_bytes=30,clump_ms=16,delay_ms=5"),
    "dropped-by-board": Case("[plate]\ndrop_rate = 0.05\n" + TOUCH, "silence_at_s=1.1,silence_for_s=0.3"),
    "tare-and-window": Case(
        touch(1.4, 7, 2.0, 0.4), orders=(SetWindow(measurement=Measurement(window_ms=40, step_ms=20)), Tare())
    ),
    "late-answers": Case(TOUCH, "answer_delay_rate=0.3,frame_delay_rate=0.05"),
    "fast-clock": Case(TOUCH, "skew_ppm=80"),
    "tick-step": Case(TOUCH, "tick_step_at_s=1.2,tick_step_ticks=5000000000"),
    "frozen": Case(TOUCH, "freeze_at_s=1.1,freeze_for_s=1.5", seconds=3.6),
    "unplugged": Case(touch(0.6, 7, 2.0, 2.5), "unplug_at_s=1.1,unplug_for_s=0.8", seconds=3.2),
    "rebooted": Case(touch(0.6, 7, 2.0, 1.5), "reboot_at_s=1.1", seconds=3.2),
    "brown-out": Case(touch(0.6, 7, 2.0, 1.5), "brown_out_at_s=1.1,misbehave=same_boot_id", seconds=3.2),
    "another-board": Case(TOUCH, "wrong_board_at_s=1.0,wrong_board_for_s=0.6", seconds=3.0),
    "refused": Case("", "misbehave=other_plate", seconds=0.5),
    "begun-in-the-middle": Case(touch(0.6, 7, 2.0, 0.8) + touch(2.2, 3, 1.0), seconds=2.5, begin_s=1.0),
    "comb": Case(touch(0.6, 7, 2.0) + touch(1.0, 11, 3.0), plate="comb16", seconds=2.0),
    "skin": Case(PRESS_AND_SHEAR, plate="small-skin", seconds=4.0),
    "skin-rebooted": Case(PRESS_AND_SHEAR, "reboot_at_s=2.8", plate="small-skin", seconds=4.0),
}
DAMAGED: Final = {"cut-off": "touches", "bit-flipped": "touches"}  # and of which recording they are made


def plate(name: str, folder: Path) -> Plate:
    """Return a plate with few frames a second."""
    path = folder / f"{name}.toml"
    if name == "small-skin":
        path.write_text(small_skin("small-skin", 2.4, 2, 10, 7))
        return load_plate(str(path))
    shipped = load_plate(name)
    slow = shipped.counter.model_copy(update={"frame_rate_hz": 100.0})
    path.write_text(plate_text(shipped.model_copy(update={"counter": slow})))
    return load_plate(str(path))


def record(case: Case, path: Path, folder: Path) -> None:
    """Record an emulated board from before its first frame on, or from a later time."""
    used = plate(case.plate, folder)
    scenario = folder / "scenario.toml"
    scenario.write_text("seed = 1\n" + case.scenario)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
    options = EmulatorOptions(
        str(folder / f"{case.plate}.toml"),
        tcp=("127.0.0.1", port),
        scenario=str(scenario),
        faults=parse_faults(case.faults),
    )
    emulator = Emulator(options)
    thread = threading.Thread(target=emulator.run)
    link = parse_link(f"tcp://127.0.0.1:{port}")
    config = config_of(used, load_settings_text(SETTINGS, scenario), link)
    origin = Origin(used, str(link), "left-index", BOOT_ID, None, plate_text(used), settings_text(config))
    switch = RecordingSwitch()
    reader = BoardReader(link, used, lambda: None, on_event=switch.put)

    def follow(seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            time.sleep(0.02)
            for arrival in reader.pop_arrivals():
                if isinstance(arrival, BoardOnline):
                    switch.name_board(arrival)

    if not case.begin_s:
        switch.start(path, origin)
    thread.start()
    reader.start()
    try:
        if case.begin_s:
            follow(case.begin_s)
            switch.start(path, origin)
        for order in case.orders:
            follow(case.seconds / 4)
            reader.request_control("key", order.model_dump_json())
        follow(case.seconds / 2)
        if case.marked:
            switch.mark("half time")
        follow(case.seconds / 2)
    finally:
        reader.stop()
        switch.stop()
        emulator.stop()
        thread.join()


def make(name: str) -> None:
    """Record a case again."""
    with tempfile.TemporaryDirectory() as temporary:
        recording = Path(temporary) / "run.mcap"
        record(CASES[name], recording, Path(temporary))
        save_case(recording, CORPUS / name)
    sys.stdout.write(f"{name} recorded\n")


def damage(name: str) -> None:
    """Make a damaged copy of a recording, and a case of it."""
    content = bytearray((CORPUS / DAMAGED[name] / RECORDING_FILE).read_bytes())
    if name == "cut-off":
        del content[len(content) // 2 :]
    else:
        content[len(content) * 3 // 4] ^= 0x10
    with tempfile.TemporaryDirectory() as temporary:
        recording = Path(temporary) / RECORDING_FILE
        recording.write_bytes(content)
        save_case(recording, CORPUS / name)


def main(arguments: list[str]) -> None:
    if arguments[:1] == ["record"]:
        names = arguments[1:] or list(CASES)
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(make, [name for name in names if name in CASES]))
        for name in DAMAGED:
            damage(name)
        return
    for path in sorted(CORPUS.glob(f"*/{EXPECTED_FILE}")):
        save_expected(path.parent)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as error:
        sys.exit(str(error))
