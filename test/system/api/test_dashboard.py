"""The dashboard in a real browser: heat, print, pause, cancel, emergency stop, on the simulated printer."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from moonraker_rig import ROOT, SimulatedPrinter, free_port
from system.api.test_moonraker import square
from webhooks.front_end import find_file

PAGES = ROOT / "klippy" / "webhooks" / "dashboard"


def test_files_come_from_the_folder_and_from_nowhere_else(tmp_path: Path) -> None:
    pages = tmp_path / "pages"
    pages.mkdir()
    (pages / "index.html").touch()
    (pages / "a.js").touch()
    (tmp_path / "secret").touch()
    (pages / "link").symlink_to(tmp_path / "secret")
    for target, name in (
        ("/", "index.html"), ("/a.js?v=1", "a.js"), ("/settings/x", "index.html"), ("/b.js", None),
        ("/../secret", None), ("/%2e%2e/secret", None), ("/link", None), ("/a.js%00", None),
    ):  # fmt: skip
        found = find_file(pages.resolve(), target)
        assert found == (None if name is None else pages.resolve() / name), target


def page_of(printer: SimulatedPrinter) -> str:
    """The address of the dashboard, from what the program says."""
    (line,) = [line for line in printer.output.splitlines() if line.startswith("front end: ")]
    return line.removeprefix("front end: ")


@pytest.fixture
def printer(tmp_path: Path) -> Iterator[SimulatedPrinter]:
    options = ["--speed", "5", "--front-end", str(PAGES), "--front-end-port", str(free_port())]
    with SimulatedPrinter(tmp_path / "data", *options) as machine:
        machine.wait_start()
        yield machine


def test_one_address_serves_the_pages_and_moonraker(printer: SimulatedPrinter) -> None:
    page = page_of(printer)
    with urllib.request.urlopen(page) as answer:
        assert b"Emergency stop" in answer.read()
    with urllib.request.urlopen(page + "server/info") as answer:
        assert json.load(answer)["result"]["klippy_state"] == "ready"


class Browser:
    """One page in headless Chromium, by its debugging protocol."""

    def __init__(self, connection: WebSocketClientConnection) -> None:
        self.connection = connection
        self._last = 0

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Answer to a command of the protocol."""
        self._last += 1
        await self.connection.write_message(
            json.dumps({"id": self._last, "method": method, "params": params})
        )
        while True:
            text = await self.connection.read_message()
            assert text is not None, "the browser has gone"
            answer = json.loads(text)
            if answer.get("id") == self._last:
                result: dict[str, Any] = answer["result"]
                return result

    async def evaluate(self, script: str) -> Any:
        """Value of an expression in the page."""
        result = await self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    async def picture(self, path: Path, width_px: int, height_px: int) -> None:
        """The page on a screen of this size, which it must fit in width."""
        size = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": width_px < 600}
        await self.call("Emulation.setDeviceMetricsOverride", **size)
        await asyncio.sleep(0.3)
        assert await self.evaluate("document.documentElement.scrollWidth") <= width_px
        shot = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(shot["data"]))

    async def wait(self, condition: str, limit_s: float = 40.0) -> None:
        """Until an expression is true in the page."""
        deadline = time.monotonic() + limit_s
        while not await self.evaluate(f"!!({condition})"):
            assert time.monotonic() < deadline, (
                f"{condition}: {await self.evaluate('document.body.innerText')}"
            )
            await asyncio.sleep(0.1)

    async def click(self, selector: str) -> None:
        await self.evaluate(f"document.querySelector({json.dumps(selector)}).click()")


async def day(browser: Browser, folder: Path) -> None:
    """What a person does."""
    text = 'document.getElementById("{}").textContent'.format
    temperature = "Number(document.querySelector('#row-extruder .temp').textContent)"
    await browser.wait('document.readyState === "complete" && document.getElementById("stop")')
    await browser.wait(f'{text("state")} === "ready" && document.querySelector("#row-extruder")')

    await browser.evaluate("document.querySelector('#row-extruder input').value = 150")
    await browser.click("#row-extruder button")
    await browser.wait(f"{temperature} > 140")
    await browser.wait("document.querySelectorAll('#chart polyline').length == 2")

    await browser.click("#files button")
    await browser.wait(f'{text("print")} === "printing" && parseFloat({text("progress")}) > 1')
    await browser.picture(folder / "dashboard.png", 900, 800)
    await browser.picture(folder / "phone.png", 390, 844)
    await browser.click("#pause")
    await browser.wait(f'{text("print")} === "paused"')
    await browser.wait(f"{temperature} < 200")  # the macro cools
    await browser.click("#resume")
    await browser.wait(f'{text("print")} === "printing"')
    await browser.click("#cancel")
    await browser.wait(f'{text("print")} === "cancelled"')

    await browser.evaluate("document.querySelector('#console-line').value = 'G1 X1000'")
    await browser.evaluate("document.querySelector('#console').requestSubmit()")
    await browser.wait("document.querySelector('#log .error')")

    await browser.click("#stop")
    await browser.wait(f'{text("state")} === "shutdown" && !document.getElementById("restart").hidden')
    await browser.click("#restart")
    await browser.wait(f'{text("state")} === "ready"')


@pytest.mark.browser
def test_heat_print_pause_cancel_and_emergency_stop_in_a_browser(
    printer: SimulatedPrinter, tmp_path: Path
) -> None:
    printer.upload("long.gcode", square(200))
    chromium = shutil.which("chromium")
    assert chromium, "Chromium is not installed; run: scripts/setup.sh browser"
    port, address = free_port(), page_of(printer)
    program = subprocess.Popen(
        [chromium, "--headless", "--no-sandbox", "--disable-gpu", f"--remote-debugging-port={port}",
         "--remote-allow-origins=*", f"--user-data-dir={tmp_path / 'profile'}", address],
        stderr=subprocess.DEVNULL,
    )  # fmt: skip

    def target() -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            pages = [page for page in json.load(answer) if page["url"] == address]
        return str(pages[0]["webSocketDebuggerUrl"]) if pages else ""

    async def drive() -> None:
        connection = await websocket_connect(printer.wait("the browser", target))
        await day(Browser(connection), tmp_path)
        connection.close()

    try:
        asyncio.run(drive())
    finally:
        program.terminate()
        program.wait(20)
