"""Pages that `calib-ros view` serves as a process, and a browser to look at them."""

from __future__ import annotations

import http.client
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from waiting import LIMIT_S, until

POLLING = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip
CHROMIUM = [
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip


class Page:
    """A page of its own process. url: as the command prints it."""

    def __init__(self, *options: str) -> None:
        command = [sys.executable, "-m", "calib_ros", "view", "--port", "0", *options]
        env = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}  # NiceGUI looks for it
        self._process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert self._process.stdout is not None
        told = ""
        while not (found := re.search(r"http://\S+:(\d+)/\S*", told)):
            line = self._process.stdout.readline()
            assert line, told
            told += line
        self.url, self.port = found[0], int(found[1])

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()

    def get(self, path: str = "/", method: str = "GET", **headers: str) -> tuple[int, bytes]:
        """Status and content."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=LIMIT_S)
        try:
            connection.request(method, path, headers=headers)
            response = connection.getresponse()
            return response.status, response.read()
        finally:
            connection.close()

    def opened(self, **headers: str) -> int:
        """Status of asking for a websocket, over which alone the page acts: 101 = it is open."""
        with socket.create_connection(("127.0.0.1", self.port), LIMIT_S) as connection:
            lines = {"Host": f"127.0.0.1:{self.port}", **UPGRADE, **headers}
            request = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
            connection.sendall(f"GET {SOCKET} HTTP/1.1\r\n{request}\r\n".encode())
            return int(connection.makefile("rb").readline().split()[1])

    def end(self, number: int = signal.SIGINT) -> None:
        """The process ends well at a signal."""
        self._process.send_signal(number)
        output = self._process.communicate(timeout=LIMIT_S)[0]
        assert self._process.returncode in (0, -number, 130), output
        assert "Traceback" not in output, output


@pytest.fixture(scope="module")
def open_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Any]]:
    """Opens an address in headless Chromium, in a window of a size, px."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium")
    chromium, driver = shutil.which("chromium") or shutil.which("chromium-browser"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no chromium and chromedriver here; install them to test the page in a browser")
    opened: list[Any] = []

    def open_one(url: str, width: int = 1400, height: int = 1000) -> Any:
        options = webdriver.ChromeOptions()
        options.binary_location = chromium
        profile: Path = tmp_path_factory.mktemp("chromium")
        for argument in (*CHROMIUM, f"--user-data-dir={profile}", f"--window-size={width},{height}"):
            options.add_argument(argument)
        browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
        opened.append(browser)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)  # windows themselves are 500 px wide at least
        browser.get(url)
        return browser

    yield open_one
    for browser in opened:
        browser.quit()


def text(browser: Any) -> str:
    """All that the page shows."""
    return str(browser.execute_script("return document.body.innerText"))


def shows(browser: Any, *words: str) -> None:
    """It does, soon."""
    until(lambda: all(word in text(browser) for word in words), words)


def press(browser: Any, *keys: str) -> None:
    """Into the element that has the focus."""
    for key in keys:
        browser.switch_to.active_element.send_keys(key)
