"""`calib-ros view`: the command as a process, and its page in a real browser where there is one."""

from __future__ import annotations

import json
import signal
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from pages import POLLING, Page, open_page, press, shows, text  # noqa: F401  # a fixture
from waiting import until

from calib_ros import result, se3
from calib_ros.cli import main
from calib_ros.datasets import open_dataset
from calib_ros.datasets.open import named_rig

pytest.importorskip("nicegui", reason="needs nicegui")
SOURCE = "synthetic:seed=1,frames=4,rings=32,width=640,height=192,speed=3,stride=10"
RIG_SOURCE = "synthetic:rig=two_lidars_three_cameras,frames=2,width=320,stride=5"
PAGES = [
    pytest.param([SOURCE, "--frames", "0"], id="source"),
    pytest.param(["--node", "/calib_ros"], id="node", marks=pytest.mark.ros),
]


@pytest.fixture(scope="module", params=PAGES)
def page(request):
    """Each kind of page; its process ends well on SIGINT."""
    with Page(*request.param) as made:
        yield made
        made.end()


def test_hostile_requests_are_refused_and_no_file_is_read(page):
    """Requests of other pages, under other names, and for files."""
    assert page.get()[0] == 200
    assert page.opened() == page.opened(Origin=f"http://127.0.0.1:{page.port}") == 101
    for headers in ({"Origin": "http://evil.example"}, {"Host": f"evil.example:{page.port}"}, {"Origin": "null"}, {"Host": ""}):
        assert page.opened(**headers) == 403, headers
        for path in ("/", POLLING, "/picture/overlay"):
            assert page.get(path, **headers)[0] == 403, (path, headers)
    etc = "..%2f..%2f..%2fetc%2fpasswd"
    pictures = (f"/picture/{etc}", "/picture/%2fetc%2fpasswd", "/picture/../../etc/passwd", "/picture/extrinsic.json")
    for path in (*pictures, "/../../etc/passwd", "/docs", "/openapi.json", "/reset"):
        status, content = page.get(path)
        assert status in (400, 403, 404, 422), path
        assert b"root:" not in content
    for path in ("/", "/calibrate", "/reset"):
        assert page.get(path, "POST")[0] in (404, 405), path


def test_with_a_token_nothing_is_told_without_it():
    with Page(SOURCE, "--frames", "0", "--token", "sesame") as page:
        assert page.url.endswith("?token=sesame")
        assert {page.get(path)[0] for path in ("/", POLLING, "/?token=open", "/picture/overlay")} == {page.opened()} == {403}
        cookie = f"calib_ros_token_{page.port}=sesame"
        assert (page.opened(Cookie=cookie), page.get(Cookie=cookie)[0]) == (101, 200)
        page.end(signal.SIGTERM)


def test_bad_requests_get_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for options, named in (
            ([SOURCE, "--port", str(taken.getsockname()[1])], "--port"),
            ([SOURCE, "--initial", "/nowhere/none.json"], "none.json"),
            ([SOURCE, "--frames", "9"], "frame"),
            ([SOURCE, "--host", "203.0.113.7"], "cannot listen"),
            ([], "name a source"),
            (["--node", "/a b"], "no name of a ROS node"),
            ([SOURCE, "--node", "/calib_ros", "--out", "x.json"], "leave out source, out"),
            ([RIG_SOURCE, "--rig", "/nowhere/rig.yaml"], "rig.yaml"),
            ([RIG_SOURCE, "--rig", "rig.yaml", "--camera", "2"], "leave them out"),
        ):
            assert main.main(["view", "--port", "0", *options]) == 2, options
            said = capsys.readouterr().err
            assert named in said
            assert said.count("\n") == 1


@pytest.fixture(scope="module")
def rig_page(tmp_path_factory):
    """Of a rig of which only priors are known."""
    source = named_rig(RIG_SOURCE)
    sensors = {name: {"kind": "camera" if name in source.cameras else "lidar"} for name in (*source.lidars, *source.cameras)}
    file = tmp_path_factory.mktemp("rig") / "rig.yaml"
    file.write_text(yaml.safe_dump({"reference": source.lidars[0], "sensors": sensors}))
    with Page(RIG_SOURCE, "--rig", str(file), "--frames", "0,1") as made:
        yield made
        made.end()


def test_the_page_of_a_rig_leads_to_those_of_its_pairs(rig_page):
    assert rig_page.get()[0] == 200
    status, content = rig_page.get("/pair/front/lidar_left")
    assert status == 200
    assert b"all sensors of the rig" in content
    assert b"Refine" in content
    status, content = rig_page.get("/pair/left/lidar_rear")
    assert status == 200
    assert b"left and lidar_rear are no pair of this rig" in content
    assert rig_page.get("/pair/..%2f..%2fetc/passwd")[0] in (200, 404)


# --- in a browser


@pytest.mark.parametrize("width", [1400, pytest.param(420, marks=pytest.mark.slow)])
def test_a_rig_in_a_browser_fits_and_shows_every_sensor(rig_page, open_page, width):  # noqa: F811
    browser = open_page(rig_page.url, width, 900)
    shows(
        browser, "nothing is estimated", "front with lidar_left", "front with lidar_right", "lidar_right", "no edges close a loop"
    )
    loaded = "return [...document.querySelectorAll('.tiles img')].filter(i => i.complete && i.naturalWidth).length"
    until(lambda: browser.execute_script(loaded) == 3, "three pictures")
    widths = browser.execute_script("return [document.documentElement.scrollWidth, window.innerWidth]")
    assert widths[0] <= widths[1]
    before = browser.execute_script("return document.querySelector('.tiles img').src")
    press(browser, "n")
    until(lambda: browser.execute_script("return document.querySelector('.tiles img').src") != before, "another picture")
    errors = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert not errors, json.dumps(errors)


class Walk:
    """The page of a start whose yaw is wrong by 3 deg. out: where it saves."""

    def __init__(self, folder: Path, open_one: Callable[..., Any]) -> None:
        self.reference = open_dataset(SOURCE).reference
        start, self.out = folder / "wrong.json", folder / "extrinsic.json"
        result.Result(se3.perturb(self.reference, [0, 3.0, 0], [0, 0, 0]), "initial").save(start)
        self.page, self._open = Page(SOURCE, "--out", str(self.out), "--initial", str(start)), open_one

    def open(self, *size: int) -> Any:
        browser = self._open(self.page.url, *size)
        until(lambda: picture(browser), "a picture")
        return browser


@pytest.fixture(scope="module")
def walk(tmp_path_factory, open_page):  # noqa: F811
    made = Walk(tmp_path_factory.mktemp("view"), open_page)
    with made.page:
        yield made
        made.page.end(signal.SIGTERM)


def picture(browser: Any) -> str:
    """Address of the picture that is loaded."""
    script = "const i = document.querySelector('.stays img'); return i && i.complete && i.naturalWidth ? i.src : ''"
    return str(browser.execute_script(script))


@pytest.mark.slow
def test_a_walk_by_keys_from_a_wrong_start_to_the_right_extrinsic(walk):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    browser = walk.open()
    before = picture(browser)

    tabs = {tab.text.strip(): tab for tab in browser.find_elements(By.CSS_SELECTOR, ".q-tab")}
    tabs["Numbers"].click()  # which then has the focus, but must not keep the arrow keys
    shows(browser, "score of each frame")
    press(browser, *[Keys.SHIFT + Keys.ARROW_LEFT] * 5)
    shows(browser, "set by hand: 2.50 deg")
    until(lambda: picture(browser) not in ("", before), "another picture")
    press(browser, Keys.ENTER)
    shows(browser, "refined:")
    shows(browser, "refine: accepted")
    press(browser, "z")
    shows(browser, "set by hand: 2.50 deg")
    press(browser, "y")
    shows(browser, "refined:")
    browser.execute_script("[...document.querySelectorAll('button')].find(b => b.innerText == 'Save').click()")
    until(walk.out.exists, "the file")
    saved = result.load(walk.out)
    assert se3.rotation_error_deg(walk.reference, saved.T_camera_lidar) < 0.2
    assert saved.converged
    errors = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert not errors, json.dumps(errors)


@pytest.mark.slow
def test_every_part_of_the_page_on_a_phone_and_all_browsers_see_the_same(walk):
    phone, other = walk.open(420, 900), walk.open()

    widths = phone.execute_script("return [document.documentElement.scrollWidth, window.innerWidth]")
    assert widths[0] <= widths[1]
    press(other, "d")
    shows(phone, "from the start", "set by hand")
    for tab, sign in (("Numbers", "score of each frame"), ("Frames", "4"), ("3-D", "drag to turn")):
        script = "[...document.querySelectorAll('.q-tab')].find(t => t.innerText.includes(arguments[0])).click()"
        phone.execute_script(script, tab)
        shows(phone, sign)
    phone.execute_script("[...document.querySelectorAll('.q-tab')][1].click()")
    lines = "return document.querySelectorAll('svg.plot polyline').length"
    until(lambda: phone.execute_script(lines) == 6, "curves of the loss")
    press(other, "h")
    until(lambda: "search:" in text(other), "a search")
    other.quit()  # in the middle of a search: the other browser goes on, and the search ends by itself
    until(lambda: "search: " in text(phone) and "%" not in text(phone).partition("search: ")[2].splitlines()[0], "its end")
