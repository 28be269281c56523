"""Draws live-view.svg: the terminal of `resonatord watch` while both plates of a demo are pressed."""

import asyncio
import io
import re
import time
from contextlib import aclosing
from pathlib import Path
from typing import Final

from rich.console import Console

from resonator_daemon.mqtt.subscriber import subscribe
from resonator_daemon.mqtt.topics import CONTACTS
from resonator_daemon.tools.command_line import broker_at
from resonator_daemon.tools.view.plate_view import PlateView
from resonator_daemon.tools.view.terminal import render

OUTPUT: Final = Path(__file__).with_name("live-view.svg")
COMMAND: Final = (".venv/bin/resonatord", "demo", "--headless", "--seconds", "60")
PRESSED_NEWTON: Final = 0.8
SHEARED_NEWTON: Final = 0.15
SKIN: Final = "skin32"


async def main() -> None:
    """Run a demo, and draw what a subscriber of its broker has when both plates are pressed."""
    demo = await asyncio.create_subprocess_exec(
        *COMMAND, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE
    )
    try:
        first = (await demo.stderr.readline()).decode() if demo.stderr is not None else ""
        url = re.search(r"mqtt://\S+?(?=;|\s)", first)
        if url is None:
            raise SystemExit(f"the demo names no broker: {first!r}")
        draw(await pressed_views(url[0]))
    finally:
        demo.terminate()
        await demo.communicate()


async def pressed_views(url: str) -> list[PlateView]:
    """Return the views of all plates at a moment when each of them is pressed."""
    views: dict[str, PlateView] = {}
    async with asyncio.timeout(60), aclosing(subscribe(broker_at(url, "resonator"), full_rate=False)) as messages:
        async for plate, path, message in messages:
            views.setdefault(plate, PlateView(plate, full_rate=False)).add(path, message, time.time_ns())
            if len(views) > 1 and all(is_pressed(view) for view in views.values()):
                break
    return [views[name] for name in sorted(views)]


def is_pressed(view: PlateView) -> bool:
    """Return whether a plate has a firm contact, a skin a sheared one."""
    contacts = view.current(CONTACTS, time.time_ns())
    for contact in contacts.contacts if contacts is not None else ():
        x, y, z = contact.force_newton
        if z > PRESSED_NEWTON and (view.name != SKIN or abs(x) + abs(y) > SHEARED_NEWTON):
            return True
    return False


def draw(views: list[PlateView]) -> None:
    console = Console(
        record=True, width=104, height=37, file=io.StringIO(), force_terminal=True, color_system="truecolor"
    )
    console.print(render(views, {}, time.time_ns(), title="resonatord watch"))
    svg = console.export_svg(title="resonatord watch")
    OUTPUT.write_text(re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL))  # fonts are those of the reader


if __name__ == "__main__":
    asyncio.run(main())
