"""The live page over a real node: what a browser shows, what keys do, and where its pictures come from."""

from __future__ import annotations

import pytest
from pages import Page, open_page, press, shows, text  # noqa: F401  # a fixture
from ros_peer import Peer, start_parameters
from vehicle import QUICK, Vehicle
from waiting import until

pytest.importorskip("nicegui", reason="needs nicegui")
pytestmark = pytest.mark.ros
ESCAPE, ENTER = "\ue00c", "\ue007"


@pytest.fixture(scope="module")
def live():
    """The page of /calib_ros."""
    with Page("--node", "/calib_ros") as page:
        yield page
        page.end()


@pytest.mark.slow
def test_a_phone_shows_node_keyframes_and_answers_by_keyboard_alone(live, open_page, street, drive):  # noqa: F811
    browser = open_page(live.url, 420, 900)

    def ask(key: str, question: str) -> None:
        press(browser, key)
        shows(browser, question)
        until(lambda: browser.execute_script("return document.activeElement.innerText.trim() == 'Yes'"), "the focus")

    shows(browser, "No node /calib_ros is heard", "ROS_DOMAIN_ID")
    with Peer(**start_parameters(drive.reference), **QUICK, online__mode="manual", initial_from_tf=False) as peer:
        vehicle = Vehicle(peer, street, drive.reference)
        peer.drive(vehicle.frame() for _ in range(4))
        shows(browser, "Nothing estimated yet", "To do: call ~/calibrate")
        shows(browser, "keyframe", "drawn in")  # by itself
        press(browser, "g")
        shows(browser, "4 keyframes, drawn in")
        loaded = "return [...document.querySelectorAll('figure img')].every(i => i.complete && i.naturalWidth > 100)"
        browser.execute_script("document.querySelector('figure').scrollIntoView()")
        until(lambda: browser.execute_script(loaded), "their pictures")
        recalibrator = peer.recalibrator
        ask("c", "Search and estimate now?")
        press(browser, ESCAPE)
        until(lambda: "Search and estimate now?" not in text(browser), "the question is gone")
        assert recalibrator.current.accepted == 0
        ask("c", "Search and estimate now?")
        press(browser, ENTER)
        shows(browser, "~/calibrate (")
        until(lambda: recalibrator.current.accepted == 1, "the estimate that was asked for")
        peer.change(search__starts=1 << 20)  # minutes
        ask("c", "Search and estimate now?")
        press(browser, ENTER)
        until(lambda: "search" in text(browser).splitlines() and "Stop" in text(browser), "how far it is")
        press(browser, ESCAPE)
        shows(browser, "stopped before the estimate was done")
        until(lambda: "Stop" not in text(browser).splitlines(), "nothing is to be stopped any more")
        assert browser.execute_script("return document.documentElement.scrollWidth") <= 420
        ask("r", "Forget all keyframes")
        press(browser, ENTER)
        shows(browser, "~/reset (")
        assert len(recalibrator.keyframes) == 0
        publisher = peer.calibration.overlay.publisher
        until(publisher.get_subscription_count, "somebody looks")
        browser.get("about:blank")
        until(lambda: publisher.get_subscription_count() == 0, "nobody looks any more")
        browser.get(live.url)
    shows(browser, "Node gone since")
