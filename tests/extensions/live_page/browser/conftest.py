"""A browser for all tests, and for each one a page that a scripted server feeds."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest_asyncio
from fake_live_page import FakeLivePage, served

if TYPE_CHECKING:
    from playwright.async_api import Browser, Page

collect_ignore = [] if find_spec("playwright") else ["test_panels.py"]  # `make test-browser` installs it
CHROMIUM = "/usr/bin/chromium"
AXE = Path(__file__).parents[4] / "build" / "browser" / "node_modules" / "axe-core" / "axe.min.js"


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def browser() -> "AsyncIterator[Browser]":
    from playwright.async_api import async_playwright, expect

    expect.set_options(timeout=20_000)  # other programs may use all cores
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM)
        yield browser
        await browser.close()


@pytest_asyncio.fixture(loop_scope="session")
async def fake() -> AsyncIterator[FakeLivePage]:
    async with served() as fake:
        yield fake


@pytest_asyncio.fixture(loop_scope="session")
async def open_page(browser: "Browser", fake: FakeLivePage) -> "AsyncIterator[Callable[..., Awaitable[Page]]]":
    """Open the page with options of a browser context; at the end nothing may have been reported as an error."""
    async with AsyncExitStack() as stack:
        errors: list[str] = []

        async def open_page(**options: Any) -> "Page":
            context = await browser.new_context(**{"viewport": {"width": 1280, "height": 900}} | options)
            stack.push_async_callback(context.close)
            page = await context.new_page()
            page.set_default_timeout(20_000)
            page.on("pageerror", lambda error: errors.append(str(error)))
            # A connection that a test ends is not an error of the page.
            page.on("console", lambda m: errors.extend([m.text] * (m.type == "error" and "WebSocket" not in m.text)))
            await page.goto(fake.url)
            await asyncio.wait_for(page.wait_for_function("() => resonatord.isOpen"), 20)
            return page

        yield open_page
        assert errors == []
