"""Holds an object by the slip margin of a skin: gripper.py HOST PORT NAME.

Prints the grip force that it wants, in newtons, a line for each decoded frame: `grip 0.612`. Replace `command` by the
driver of your gripper; the other finger presses as hard.
"""

import asyncio
import math
import sys

import resonatord

TARGET_MARGIN = 0.17  # of the friction: holds with 1 / (1 - 0.17) = 1.2 times the least force
START_NEWTON, MOST_NEWTON = 0.4, 4.0
TIGHTEN, RELAX_NEWTON_PER_S = 1.1, 1.0  # times what is measured, with each frame; the grip loosens slowly

if len(sys.argv) != 4:
    sys.exit("usage: gripper.py HOST PORT NAME, as 127.0.0.1 1883 left-index")
host, port, name = sys.argv[1:]


class Grip:
    """The force that is wanted; `update` takes what the skin measures."""

    def __init__(self):
        self.newton, self._t_ns = START_NEWTON, None

    def update(self, t_ns, contact):
        passed_s = (t_ns - (self._t_ns or t_ns)) * 1e-9
        self._t_ns = t_ns
        normal, margin = contact.force_newton[2], contact.slip_margin
        if math.isfinite(normal) and math.isfinite(margin):  # unknown while there is little shear: nothing changes
            least = normal * (1.0 - margin)  # that friction needs; while the object slides, it needs more
            wanted = min(least / (1.0 - TARGET_MARGIN), normal * TIGHTEN)
            loosest = self.newton - RELAX_NEWTON_PER_S * passed_s
            self.newton = min(max(wanted, loosest, START_NEWTON), MOST_NEWTON)
        return self.newton


def command(newton):
    print(f"grip {newton:.3f}", flush=True)


async def main():
    grip, is_skin = Grip(), False
    command(grip.newton)
    async for _, path, message in resonatord.subscribe(f"mqtt://{host}:{port}", name, ("info", "contacts")):
        if path == "info" and message.skin is None:
            raise resonatord.UserError(f"{name} has no skin: its contacts have no slip margin")
        is_skin |= path == "info"
        if is_skin and path == "contacts" and message.contacts:
            command(grip.update(message.t_ns, message.contacts[0]))  # one object, one contact


try:
    asyncio.run(main())
except resonatord.UserError as error:
    sys.exit(str(error))
except KeyboardInterrupt:
    pass
