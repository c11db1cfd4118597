"""The live page over a real node: what a browser shows, what keys do, and what requests cannot do."""

from __future__ import annotations

import http.client
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter
from ros_peer import Peer, start_parameters
from vehicle import QUICK, Vehicle

from calib_ros.cli import main
from calib_ros.frame import Frame
from calib_ros_synthetic.drive import SyntheticDrive

pytest.importorskip("nicegui", reason="needs nicegui")
pytestmark = pytest.mark.ros
CHROMIUM = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--window-size=420,900",
]  # fmt: skip


def until(condition: Callable[[], Any], what: str, seconds: float = 30.0) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.05)
    raise AssertionError(f"did not happen within {seconds} s: {what}")


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Of a server with the live page of /calib_ros; it ends well on SIGINT."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        number = free.getsockname()[1]
    with served("--port", str(number)) as process:
        assert f"http://127.0.0.1:{number}" in first_line(process)
        yield number
        process.send_signal(signal.SIGINT)
        output = process.communicate(timeout=20)[0]
        assert "Traceback" not in output, output


@contextmanager
def served(*options: str) -> Iterator[subprocess.Popen[str]]:
    """The command as a process."""
    command = [sys.executable, "-m", "calib_ros", "view", "--node", "/calib_ros", *options]
    env = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}  # NiceGUI looks for it
    process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def first_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


def get(port: int, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.request(method, path, headers=headers)
        response = connection.getresponse()
        return response.status, response.read()
    finally:
        connection.close()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    profile: Path = tmp_path_factory.mktemp("chromium")
    for argument in (*CHROMIUM, f"--user-data-dir={profile}"):
        options.add_argument(argument)
    started = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    phone = {"width": 420, "height": 900, "deviceScaleFactor": 1, "mobile": False}  # windows themselves are 500 px wide at least
    started.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", phone)
    yield started
    started.quit()


def body(browser: Any) -> str:
    return str(browser.execute_script("return document.body.innerText"))


def press(browser: Any, *keys: str) -> None:
    from selenium.webdriver import ActionChains

    ActionChains(browser).send_keys(*keys).perform()


def test_pictures_come_from_memory_and_requests_call_no_service(port: int) -> None:
    assert get(port, "/live/overlay.jpg")[0] == 404, "no picture yet"
    assert get(port, "/live/keyframe/1.jpg")[0] == 404
    for path in ("/live/keyframe/..%2f..%2fetc%2fpasswd.jpg", "/live/keyframe/%2fetc%2fpasswd.jpg", "/live/../../etc/passwd"):
        status, content = get(port, path)
        assert status in (404, 422)
        assert b"root:" not in content
    for path in ("/", "/live/calibrate", "/calibrate", "/reset"):
        assert get(port, path, "POST")[0] in (404, 405)
    assert get(port, "/reset")[0] == 404


POLLING = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip


def opened(port: int, path: str = SOCKET, **headers: str) -> int:
    """Status of asking for a websocket, over which alone services are called: 101 = it is open."""
    with socket.create_connection(("127.0.0.1", port), 20) as connection:
        lines = {"Host": f"127.0.0.1:{port}", **UPGRADE, **headers}
        request = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
        connection.sendall(f"GET {path} HTTP/1.1\r\n{request}\r\n".encode())
        return int(connection.makefile("rb").readline().split()[1])


def test_other_pages_and_names_cannot_reach_the_services(port: int) -> None:
    assert opened(port) == 101
    assert opened(port, Origin=f"http://127.0.0.1:{port}") == 101
    for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": f"evil.example:{port}"}, {"Host": ""}):
        assert opened(port, **headers) == 403, headers
    for path in ("/", POLLING, "/live/overlay.jpg"):
        assert get(port, path, Origin="http://evil.example")[0] == 403, path
        assert get(port, path, Host=f"evil.example:{port}")[0] == 403, path


def test_with_a_token_nothing_is_told_without_it() -> None:
    with served("--port", "0", "--token", "sesame") as process:
        address = re.search(r":(\d+)/\?token=sesame", first_line(process))
        assert address
        port = int(address[1])
        assert opened(port) == 403
        assert opened(port, Cookie=f"calib_ros_token_{port}=open") == 403
        assert opened(port, Cookie=f"calib_ros_token_{port}=sesame", Origin="http://evil.example") == 403
        assert opened(port, Cookie=f"calib_ros_token_{port}=sesame") == 101
        for path in ("/", POLLING, "/live/overlay.jpg", "/live/keyframe/1.jpg"):
            assert get(port, path)[0] == 403, path
            assert get(port, path.partition("?")[0] + "?token=open")[0] == 403, path
        assert get(port, "/?token=sesame")[0] in (200, 302, 303, 307)
        process.send_signal(signal.SIGTERM)
        process.wait(20)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "name a source"),
        (["--node", "/a b"], "no name of a ROS node"),
        (["synthetic:frames=1", "--node", "/calib_ros", "--out", "x.json"], "leave out source, out"),
    ],
)
def test_bad_arguments_say_what_to_do(options: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["view", *options, "--port", "0"]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.slow
def test_a_phone_shows_node_keyframes_and_answers_by_keyboard_alone(
    port: int, browser: Any, street: list[Frame], drive: SyntheticDrive
) -> None:
    browser.get(f"http://127.0.0.1:{port}/")
    until(lambda: "No node /calib_ros is heard" in body(browser), "the page says that it waits")
    assert "ROS_DOMAIN_ID" in body(browser)
    with Peer(**start_parameters(drive.reference), **QUICK, online__mode="manual", initial_from_tf=False) as peer:
        vehicle = Vehicle(peer, street, drive.reference)
        for _ in range(4):
            peer.publish(vehicle.frame())
        until(lambda: "Nothing estimated yet" in body(browser), "the status in words")
        until(lambda: "keyframe" in body(browser) and "drawn in" in body(browser), "the gallery fills by itself")
        press(browser, "g")
        until(lambda: "4 keyframes, drawn in" in body(browser), "keyframes")
        loaded = "return [...document.querySelectorAll('figure img')].every(i => i.complete && i.naturalWidth > 100)"
        browser.execute_script("document.querySelector('figure').scrollIntoView()")
        until(lambda: browser.execute_script(loaded) or press(browser), "their pictures")
        recalibrator = peer.calibration.pipeline.recalibrator
        press(browser, "c")
        until(lambda: "Search and estimate now?" in body(browser), "the question")
        press(browser, "\ue00c")  # Esc
        until(lambda: "Search and estimate now?" not in body(browser), "the question is gone")
        assert recalibrator.current.accepted == 0
        press(browser, "c")
        until(lambda: "Search and estimate now?" in body(browser), "the question")
        time.sleep(0.5)  # the dialog takes the focus when it is open
        press(browser, "\ue007")  # Enter
        until(lambda: "~/calibrate (" in body(browser), "the answer", 90)
        assert recalibrator.current.accepted == 1
        assert peer.node.set_parameters([Parameter("search.starts", value=1 << 20)])[0].successful  # minutes
        press(browser, "c")
        until(lambda: "Search and estimate now?" in body(browser), "the question")
        time.sleep(0.5)
        press(browser, "\ue007")
        until(lambda: "search" in body(browser).splitlines() and "Stop" in body(browser), "how far it is")
        press(browser, "\ue00c")
        until(lambda: "stopped before the estimate was done" in body(browser), "it is stopped")
        until(lambda: "Stop" not in body(browser).splitlines(), "nothing is to be stopped any more")
        assert browser.execute_script("return document.documentElement.scrollWidth") <= 420
        press(browser, "r")
        until(lambda: "Forget all keyframes" in body(browser), "the question")
        time.sleep(0.5)
        press(browser, "\ue007")
        until(lambda: "~/reset (" in body(browser), "the answer")
        assert len(recalibrator.buffer) == 0
        publisher = peer.calibration.overlay._publisher
        until(publisher.get_subscription_count, "somebody looks")
        browser.get("about:blank")
        until(lambda: publisher.get_subscription_count() == 0, "nobody looks any more")
        browser.get(f"http://127.0.0.1:{port}/")
    until(lambda: "Node gone since" in body(browser), "the page says that the node is gone")
