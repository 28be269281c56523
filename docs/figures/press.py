"""Draw press.svg: one press on an emulated plate as it is measured, with its errors, next to the truth."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import resonatord
from matplotlib.figure import Figure

OUTPUT = Path(__file__).with_name("press.svg")
PROGRAM = str(Path(sys.executable).parent / "resonatord")
SECONDS = "8"
AROUND_S = 0.15
NS_PER_S = 1e9


def main() -> None:
    """Record an emulated plate for some seconds and draw the longest press."""
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder)
        truth_file, recording_file = files / "truth.jsonl", files / "run.mcap"
        emulator = subprocess.Popen(
            [PROGRAM, "emulate", "--plate", "quartz16", "--tcp", "127.0.0.1:0", "--truth", str(truth_file), "--json"],
            stdout=subprocess.PIPE,
            text=True,
        )
        link = json.loads(emulator.stdout.readline())["link"] if emulator.stdout else ""
        (files / "plate.toml").write_text(f'name = "left-index"\nplate = "quartz16"\nlink = "{link}"\n')
        record = [PROGRAM, "record", "--config", files / "plate.toml", "--output", recording_file]
        subprocess.run([*record, "--seconds", SECONDS], check=True, stdout=subprocess.DEVNULL)
        emulator.terminate()
        emulator.communicate()
        draw(resonatord.load_recording(recording_file), truth_file)


def draw(recording: resonatord.LoadedRecording, truth_file: Path) -> None:
    """Draw the press that lasts longest."""
    events = recording.contact_events
    releases = np.flatnonzero(events["event"] == "release")
    last = releases[np.argmax(events["contact_duration_s"][releases])]
    number, end_ns = events["contact_id"][last], events["t_ns"][last]
    start_ns = end_ns - events["contact_duration_s"][last] * NS_PER_S
    contacts = recording.contacts
    mine = contacts["contact_id"] == number
    time_s = (contacts["t_ns"][mine] - start_ns) / NS_PER_S
    force = contacts["contact_force_z_newton"][mine]
    error = np.hypot(contacts["contact_systematic_z_newton"][mine], contacts["contact_noise_z_newton"][mine])
    true_s, true_newton = true_force(truth_file, start_ns, end_ns)

    matplotlib.rcParams["svg.hashsalt"] = "resonatord"
    figure = Figure(figsize=(7.5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.fill_between(time_s, force - 2 * error, force + 2 * error, color="#c25b12", alpha=0.25, linewidth=0)
    axes.plot(
        time_s, force, color="#c25b12", label="measured, with two standard deviations of noise and systematic error"
    )
    axes.plot(true_s, true_newton, color="#1c2e40", linestyle="--", linewidth=1, label="true, by the emulator")
    axes.set(xlabel="time since onset in s", ylabel="force in N", ylim=(0.0, None))
    axes.legend(loc="lower center", fontsize=8)
    figure.savefig(OUTPUT, metadata={"Date": None})


def true_force(file: Path, start_ns: float, end_ns: float) -> tuple[list[float], list[float]]:
    """Return time since the onset in s, and total normal force in N, around a press."""
    times_s, forces_newton = [], []
    for line in file.read_text().splitlines():
        frame = json.loads(line)
        since_s = (int(frame["t_ns"]) - start_ns) / NS_PER_S
        if -AROUND_S < since_s < (end_ns - start_ns) / NS_PER_S + AROUND_S:
            times_s.append(since_s)
            forces_newton.append(sum(touch["force_newton"][2] for touch in frame["contacts"]))
    return times_s, forces_newton


if __name__ == "__main__":
    main()
