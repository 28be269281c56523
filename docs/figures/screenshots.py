"""Take pictures of the live page in Debian's chromium: emulated plates that are pressed with the mouse."""

import asyncio
import tempfile
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Final

from PIL import Image
from playwright.async_api import Browser, Page, TimeoutError, async_playwright

from resonator_daemon.tools.demo.processes import local_broker

FOLDER: Final = Path(__file__).parent
CHROMIUM: Final = "/usr/bin/chromium"
RESONATORD: Final = ".venv/bin/resonatord"
PLACES_MM: Final = {"quartz16": (-3.7, -0.7), "skin32": (-0.6, 0.4)}  # a site; near the middle
DRAG_MM: Final = 3.2
PRESS_S: Final = 0.9
WAIT_S: Final = 60.0
SHOWN_S: Final = 5.0  # a press that is not shown by then is made again
LINK: Final = "127.0.0.1:7411"
READY: Final = "() => resonatord.views[0].model.newest('contacts')"
PRESSED: Final = "() => resonatord.views[0].model?.newest('contacts')?.contacts.some(({force}) => force[2] > 0.8)"
SHEARED: Final = "() => resonatord.views[0].model.newest('contacts')?.contacts.some(({slipMargin}) => slipMargin < 0.9)"
PIXEL: Final = """([kind, x, y]) => { const scene = resonatord.views[0][kind].scene;
  const box = scene.canvas.getBoundingClientRect(); return [box.left + scene.x(x), box.top + scene.y(y)]; }"""
CLEAR: Final = """() => { const { root, model } = resonatord.views[0];
  const corners = root.querySelectorAll('.rung.identified[data-site="2"]').length;
  return !root.matches('.stale') && root.querySelector('.situation').dataset.situation === 'well'
    && model.newest('contacts').contacts.length === 1 && (model.isSkin || corners === 4); }"""
PRESSES_MAX: Final = 12
CASES: Final = {  # plate, width, height, colours
    "live-page-quartz16": ("quartz16", 1400, 900, "light"),
    "live-page-skin32": ("skin32", 1400, 900, "light"),
    "live-page-dark": ("skin32", 1400, 900, "dark"),
    "live-page-phone": ("skin32", 390, 844, "light"),
}


@asynccontextmanager
async def child(*command: str, output: int = DEVNULL) -> AsyncIterator[Process]:
    """Run a command of resonatord within the context."""
    process = await asyncio.create_subprocess_exec(RESONATORD, *command, stdout=output, stderr=DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        await process.communicate()


async def line(process: Process) -> str:
    """Return the first line that a command prints."""
    return (await process.stdout.readline()).decode() if process.stdout is not None else ""


async def start(stack: AsyncExitStack, folder: Path, plate: str) -> str:
    """Run a broker, a plate with its daemon, and the page; return its address."""
    broker = await stack.enter_async_context(local_broker(folder))
    control = str(folder / "control")
    emulate = ("emulate", "--plate", plate, "--tcp", LINK, "--scenario", "still", "--control", control, "--json")
    await line(await stack.enter_async_context(child(*emulate, output=PIPE)))
    config = folder / "plate.toml"
    commands = '["tare", "mark", "start_recording", "stop_recording"]'
    config.write_text(
        f'name = "{plate}"\nplate = "{plate}"\nlink = "tcp://{LINK}"\n[mqtt]\nurl = "{broker.url}"\n'
        f"[commands]\nallow = {commands}\n"
    )
    await stack.enter_async_context(child("run", "--config", str(config)))
    view = ("view", "--url", broker.url, "--listen", "127.0.0.1:0", "--allow-commands", "--press", control)
    return (await line(await stack.enter_async_context(child(*view, output=PIPE)))).split()[-1]


async def press(page: Page, plate: str) -> None:
    """Hold the mouse on the plate; drag on a skin, until the slip margin shows it."""
    kind = "surface" if plate == "skin32" else "plate"
    x_m, y_m = (1e-3 * place for place in PLACES_MM[plate])
    await page.mouse.move(*await page.evaluate(PIXEL, [kind, x_m, y_m]))
    await page.mouse.down()
    await page.wait_for_function(PRESSED, timeout=1e3 * SHOWN_S)
    await page.wait_for_timeout(1e3 * PRESS_S)
    if plate == "skin32":
        await page.mouse.move(*await page.evaluate(PIXEL, [kind, x_m + 1e-3 * DRAG_MM, y_m]), steps=20)
        await page.wait_for_function(SHEARED, timeout=1e3 * SHOWN_S)
    await page.wait_for_timeout(400)


async def take(browser: Browser, url: str, name: str) -> None:
    """Open the page, press the plate, and write one picture."""
    plate, width, height, colours = CASES[name]
    size = {"width": width, "height": height}
    is_phone = width < 500
    page = await browser.new_page(
        viewport=size,  # type: ignore[arg-type]
        color_scheme=colours,  # type: ignore[arg-type]
        device_scale_factor=1,
        has_touch=is_phone,
        is_mobile=is_phone,
    )
    await page.goto(f"{url}#{plate}")
    await page.wait_for_selector(".pressable [data-situation=well]", timeout=1e3 * WAIT_S)
    await page.wait_for_function(READY, timeout=1e3 * WAIT_S)
    is_clear = False
    for presses in range(PRESSES_MAX):  # the first press leaves its trace in the force over the last minute
        with suppress(TimeoutError):
            await press(page, plate)
            await page.screenshot(path=FOLDER / f"{name}.png")
            is_clear = presses > 0 and await page.evaluate(CLEAR)
        await page.mouse.up()
        if is_clear:
            break
        await page.wait_for_timeout(800)
    await page.close()
    if not is_clear:
        raise SystemExit(f"{name}: of {PRESSES_MAX} presses, each was late or missed; try again while less else runs")
    Image.open(FOLDER / f"{name}.png").save(FOLDER / f"{name}.webp", quality=80, method=6)
    (FOLDER / f"{name}.png").unlink()
    print(f"{name}.webp: {(FOLDER / f'{name}.webp').stat().st_size / 1e3:.0f} kB")


async def main() -> None:
    """Take all pictures."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM)
        for shown in dict.fromkeys(plate for plate, *_ in CASES.values()):
            async with AsyncExitStack() as stack:
                url = await start(stack, Path(stack.enter_context(tempfile.TemporaryDirectory())), shown)
                for name, (plate, *_) in CASES.items():
                    if plate == shown:
                        await take(browser, url, name)
        await browser.close()


if __name__ == "__main__":
    asyncio.run(main())
