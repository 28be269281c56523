"""How firmly does docs/examples/python/gripper.py hold an object, of the least grip, and how far does the object slide.

Run it with `python benchmarks/gripper.py`. The object is between two fingers, one of which is an emulated skin32. It is
lifted within a second; a second later its friction drops. The exit code is 1 if it falls, if half a second after a
change the grip is below the least one, or if it ever exceeds 1.3 times that.
"""

import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass

from parts import NAME, ROOT, child, running, until

GRAVITY, MASS_KG = 9.81, 0.05
FRICTION, FRICTION_AFTER = 0.5, 0.4
LIFTED_S, DROP_S, END_S = 1.0, 2.0, 4.0
SETTLED_S = 0.5  # after the lift, and after the drop
STEP_S = 0.005
FALLEN_M = 0.02  # of the way that the object may slide between the fingers
GRIP_MAX = 1.3  # times the least one


@dataclass
class Object:
    """What two fingers hold, each with half of the load; it slides where friction cannot bear it."""

    grip_newton: float = 0.4
    slid_m: float = 0.0
    speed_m_s: float = 0.0
    now_s: float = 0.0

    @property
    def friction(self) -> float:
        return FRICTION if self.now_s < DROP_S else FRICTION_AFTER

    @property
    def load_newton(self) -> float:
        """Of each finger: a table bears the rest until it is lifted."""
        return MASS_KG * GRAVITY / 2.0 * min(self.now_s / LIFTED_S, 1.0)

    @property
    def least_newton(self) -> float:
        return self.load_newton / self.friction

    def step(self, now_s: float) -> list[float]:
        """Go on to that time; return the force on a finger."""
        passed_s, self.now_s = now_s - self.now_s, now_s
        borne_newton = self.friction * self.grip_newton
        lacking_newton = self.load_newton - borne_newton
        self.speed_m_s = max(0.0, self.speed_m_s + 2.0 * lacking_newton / MASS_KG * passed_s)
        self.slid_m += self.speed_m_s * passed_s
        slides = self.speed_m_s > 0.0 or lacking_newton > 0.0
        return [0.0, borne_newton if slides else self.load_newton, self.grip_newton]


def hold(held: Object, control: socket.socket, follows: threading.Event) -> list[tuple[float, float]]:
    """Press as the object does; return times and grips, of the least one, from when it is lifted."""
    answers, shares, began_s = control.makefile(), list[tuple[float, float]](), time.monotonic()
    while (now_s := time.monotonic() - began_s) < END_S:
        if not follows.is_set():  # the object lies on the table
            began_s, now_s = time.monotonic(), 0.0
        press = {"press": "object", "position_m": [0, 0], "force_newton": held.step(now_s)}
        control.sendall(json.dumps(press | {"friction_coefficient": held.friction}).encode() + b"\n")
        answers.readline()
        if now_s >= LIFTED_S:
            shares.append((now_s, held.grip_newton / held.least_newton))
        time.sleep(STEP_S)
    return shares


def main() -> int:
    held, follows = Object(), threading.Event()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as parts:
        control_path = f"{folder}/control"
        system = parts.enter_context(running("skin32", "--control", control_path, paths=("contacts",)))
        until(lambda: "contacts" in system.counts, "a message on contacts")
        example = str(ROOT / "docs" / "examples" / "python" / "gripper.py")
        controller = parts.enter_context(
            child(sys.executable, example, "127.0.0.1", str(system.port), NAME, stdout=subprocess.PIPE)
        )

        def follow() -> None:
            for number, line in enumerate(controller.stdout or ()):
                held.grip_newton = float(line.split()[1])
                if number:  # the first one is printed before a contact arrives
                    follows.set()

        threading.Thread(target=follow, daemon=True).start()
        control = parts.enter_context(socket.socket(socket.AF_UNIX))
        control.connect(control_path)
        shares = hold(held, control, follows)
    settled = [share for now_s, share in shares if (now_s - LIFTED_S) % (DROP_S - LIFTED_S) > SETTLED_S]
    highest = max(share for _, share in shares)
    print(f"slid {held.slid_m * 1e3:.2f} mm; grip of the least {min(settled):.3f} to {highest:.3f}")
    return int(held.speed_m_s > 0.0 or held.slid_m > FALLEN_M or min(settled) <= 1.0 or highest >= GRIP_MAX)


if __name__ == "__main__":
    sys.exit(main())
