"""`calib-ros view`: the command as a process, and its page in a real browser where there is one."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from calib_ros import result, se3
from calib_ros.datasets import open_dataset

SOURCE = "synthetic:seed=1,frames=4,rings=32,width=640,height=192,speed=3,stride=10"
START_S = 60
CHROMIUM, DRIVER = shutil.which("chromium") or shutil.which("chromium-browser"), shutil.which("chromedriver")


class Server:
    """A page that is served by a process."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.out = folder / "extrinsic.json"
        command = [sys.executable, "-m", "calib_ros", "view", SOURCE, "--port", "0", "--out", str(self.out), *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        found = re.search(r"open (http\S+)", line)
        assert found, self.process.communicate(timeout=10)
        self.url = found[1]

    def status(self, path: str = "", **headers: str) -> int:
        request = urllib.request.Request(self.url.partition("?")[0] + path, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return int(answer.status)
        except urllib.error.HTTPError as error:
            return error.code

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(20)
        self.process.communicate()
        return code


@pytest.fixture(scope="module")
def wrong_start(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A start whose yaw is wrong by 3 deg."""
    path = tmp_path_factory.mktemp("start") / "wrong.json"
    reference = open_dataset(SOURCE).reference
    assert reference is not None
    result.Result(se3.perturb(reference, [0, 3.0, 0], [0, 0, 0]), "initial").save(path)
    return path


@pytest.fixture(scope="module")
def server(wrong_start: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    made = Server(tmp_path_factory.mktemp("view"), "--initial", str(wrong_start))
    yield made
    assert made.end() in (0, -signal.SIGTERM)


def test_hostile_requests_are_refused_and_no_file_is_read(server: Server) -> None:
    assert server.status() == 200
    port = server.url.rpartition(":")[2].strip("/")
    assert server.status(Origin="http://evil.example") == 403
    assert server.status(Host=f"evil.example:{port}") == 403
    handshake = "_nicegui_ws/socket.io/?EIO=4&transport=polling"
    assert server.status(handshake, Origin="http://evil.example") == 403
    for path in ("picture/..%2f..%2f..%2fetc%2fpasswd", "picture/extrinsic.json", "../../etc/passwd", "docs", "openapi.json"):
        assert server.status(path) in (400, 403, 404), path


def test_with_a_token_nothing_is_told_without_it(tmp_path: Path) -> None:
    own = Server(tmp_path, "--token", "sesame", "--frames", "0")
    assert own.url.endswith("?token=sesame")
    assert own.status() == 403
    assert own.status("_nicegui_ws/socket.io/?EIO=4&transport=polling") == 403
    assert own.status("?token=open") == 403
    assert own.status("?token=sesame") == 200
    assert own.status(Cookie=f"calib_ros_token_{urlsplit(own.url).port}=sesame") == 200
    assert own.end() in (0, -signal.SIGTERM)


def test_bad_requests_get_one_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        for options, named in (
            (["--port", str(taken.getsockname()[1])], "--port"),
            (["--initial", str(tmp_path / "none.json")], "none.json"),
            (["--frames", "9"], "frame"),
            (["--host", "203.0.113.7"], "cannot listen"),
        ):
            command = [sys.executable, "-m", "calib_ros", "view", SOURCE, "--port", "0", *options]
            done = subprocess.run(command, capture_output=True, text=True, timeout=START_S)
            assert done.returncode == 2, done
            assert named in done.stderr
            assert done.stderr.count("\n") == 1


# --- in a browser


@pytest.fixture(scope="module")
def open_page(server: Server) -> Iterator[Callable[..., Any]]:
    """Opens the page in headless Chromium, at a size."""
    webdriver = pytest.importorskip("selenium.webdriver")
    if not (CHROMIUM and DRIVER):
        pytest.skip("no chromium and chromedriver here; install them to test the page in a browser")
    from selenium.webdriver.chrome.service import Service

    opened: list[Any] = []

    def open_one(width: int = 1400, height: int = 1000) -> Any:
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        for flag in ("headless=new", "no-sandbox", "disable-gpu", "no-first-run", "disable-background-networking"):
            options.add_argument(f"--{flag}")
        options.add_argument(f"--window-size={width},{height}")
        browser = webdriver.Chrome(options=options, service=Service(DRIVER))
        opened.append(browser)
        browser.set_window_size(width, height)
        browser.get(server.url)
        wait_for(lambda: picture(browser))
        return browser

    yield open_one
    for browser in opened:
        browser.quit()


def wait_for(what: Callable[[], Any], seconds: float = 30) -> Any:
    deadline = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found


def picture(browser: Any) -> str:
    """Address of the picture that is loaded."""
    script = "const i = document.querySelector('.stays img'); return i && i.complete && i.naturalWidth ? i.src : ''"
    return str(browser.execute_script(script))


def text(browser: Any) -> str:
    return str(browser.execute_script("return document.body.innerText"))


def press(browser: Any, *keys: str) -> None:
    for key in keys:
        browser.switch_to.active_element.send_keys(key)


@pytest.mark.slow
def test_a_walk_by_keys_from_a_wrong_start_to_the_right_extrinsic(open_page: Callable[..., Any], server: Server) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    browser = open_page()
    before = picture(browser)
    tabs = {tab.text.strip(): tab for tab in browser.find_elements(By.CSS_SELECTOR, ".q-tab")}
    tabs["Numbers"].click()  # which then has the focus, but must not keep the arrow keys
    wait_for(lambda: "score of each frame" in text(browser))
    press(browser, *[Keys.SHIFT + Keys.ARROW_LEFT] * 5)
    wait_for(lambda: "set by hand: 2.50 deg" in text(browser))
    wait_for(lambda: picture(browser) not in ("", before))
    press(browser, Keys.ENTER)
    wait_for(lambda: "refined:" in text(browser))
    wait_for(lambda: "refine: accepted" in text(browser))
    press(browser, "z")
    wait_for(lambda: "set by hand: 2.50 deg" in text(browser))
    press(browser, "y")
    wait_for(lambda: "refined:" in text(browser))
    browser.execute_script("[...document.querySelectorAll('button')].find(b => b.innerText == 'Save').click()")
    wait_for(server.out.exists)
    saved, reference = result.load(server.out), open_dataset(SOURCE).reference
    assert reference is not None
    assert se3.rotation_error_deg(reference, saved.T_camera_lidar) < 0.2
    assert saved.converged
    errors = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert not errors, json.dumps(errors)


@pytest.mark.slow
def test_every_part_of_the_page_on_a_phone_and_all_browsers_see_the_same(open_page: Callable[..., Any]) -> None:
    phone, other = open_page(420, 900), open_page()
    widths = phone.execute_script("return [document.documentElement.scrollWidth, window.innerWidth]")
    assert widths[0] <= widths[1]
    press(other, "d")
    wait_for(lambda: "from the start" in text(phone) and "set by hand" in text(phone))
    for tab, sign in (("Numbers", "score of each frame"), ("Frames", "4"), ("3-D", "drag to turn")):
        script = "[...document.querySelectorAll('.q-tab')].find(t => t.innerText.includes(arguments[0])).click()"
        phone.execute_script(script, tab)
        wait_for(lambda sign=sign: sign in text(phone))
    phone.execute_script("[...document.querySelectorAll('.q-tab')][1].click()")
    wait_for(lambda: phone.execute_script("return document.querySelectorAll('svg.plot polyline').length") == 6)
    press(other, "h")
    wait_for(lambda: "search:" in text(other))
    other.quit()  # in the middle of a search: the other browser goes on, and the search ends by itself
    wait_for(lambda: "search: " in text(phone) and "%" not in text(phone).partition("search: ")[2].splitlines()[0])


def test_the_process_ends_cleanly(tmp_path: Path) -> None:
    own = Server(tmp_path, "--frames", "0")
    os.kill(own.process.pid, signal.SIGINT)
    assert own.process.wait(20) in (0, -signal.SIGINT, 130)
    assert "Traceback" not in (own.process.communicate()[1] or "")
