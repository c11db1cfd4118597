"""`calib-ros view`: a page in the browser, over a source or a running node."""

from __future__ import annotations

import argparse
import json
import sys
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

from calib_ros.cli.inputs import bag_options, configuration, initial_extrinsic, open_named_source
from calib_ros.cli.output import note, progress_bar
from calib_ros.datasets.open import open_rig
from calib_ros.datasets.source import frame_positions, spread_positions
from calib_ros.errors import BadInputError
from calib_ros.io import check_output
from calib_ros.registration.progress import Progress
from calib_ros.rig.description import read_rig
from calib_ros.rig.edges import priors_of
from calib_ros.rig.graph import solve
from calib_ros.rig.report import load
from calib_ros.runtime import return_freed_memory
from calib_ros_check.rig.shown import of_priors, of_result
from calib_ros_view.session.rig_session import RigSession
from calib_ros_view.session.session import Session, SessionJobs
from calib_ros_view.web.server import RIG, Address, Opened, Opening, Pictures, listening, require_nicegui, serve

FRAMES = 10  # of a source, unless said otherwise
OUT = "extrinsic.json"
TITLE = "calib-ros view"
OF_ONE_PAIR = ("yaw_deg", "camera", "image_topic", "points_topic", "camera_info_topic", "rectified")
OF_SOURCES = (
    *("source", "rig", "initial", "yaw_deg", "config", "frames", "out"),
    *("camera", "image_topic", "points_topic", "camera_info_topic", "rectified", "clock", "incomplete"),
)
Shown = tuple[str, Callable[[], None], Opening | None]  # title, builds the page for a browser, opens those of a rig's pairs


def view(args: argparse.Namespace) -> None:
    """Serve the page until it is ended. BadInputError for what cannot be shown, or an address that cannot be used."""
    if args.source is None and args.node is None:
        raise BadInputError("nothing to view: name a source (a recording), or a running node with --node /calib_ros")
    require_nicegui()
    return_freed_memory()  # before there are threads: pictures and features of many sizes left gaps of half a gigabyte
    address, pictures = Address(args.host, args.port, args.token), Pictures()
    listening(address).close()  # before frames are read for nothing
    made = _of_node if args.node is not None else _of_rig if args.rig is not None else _of_source

    def ready(url: str) -> None:
        print(f"open {url} (Ctrl-C ends)", flush=True)
        if args.open and not webbrowser.open(url):
            print("no browser found here", file=sys.stderr)

    with made(args, pictures) as (title, page, opening):
        serve(page, title, address, pictures, ready, opening)


def _refuse(args: argparse.Namespace, options: Sequence[str], why: str) -> None:
    """BadInputError where any of the options is given. why: with the place of their names."""
    if given := [name.replace("_", "-") for name in options if getattr(args, name)]:
        raise BadInputError(why.format(", ".join(given)))


@contextmanager
def _of_node(args: argparse.Namespace, pictures: Pictures) -> Iterator[Shown]:
    """A running node, of a pair or a rig."""
    _refuse(args, OF_SOURCES, "--node watches a running node: leave out {}, which only a source can have")
    from calib_ros_view.node.watch import Watch
    from calib_ros_view.web.live_page import Gallery, live_page

    with Watch(args.node) as watch:

        def opening(camera: str, lidar: str) -> Opened:
            if (camera, lidar) not in watch.pairs:
                raise BadInputError(f"{watch.name} has no pair of {camera} and {lidar}; open one that its page lists")
            own = Watch(f"{watch.name}/{camera}/{lidar}")
            return partial(live_page, own, pictures, Gallery(own, pictures), RIG), own.close

        yield f"{watch.name} · {TITLE}", partial(live_page, watch, pictures, Gallery(watch, pictures)), opening


@contextmanager
def _of_rig(args: argparse.Namespace, pictures: Pictures) -> Iterator[Shown]:
    """A recording of several sensors."""
    _refuse(args, OF_ONE_PAIR, f"--rig says what {{}} would: leave them out, and set them in {args.rig}")
    from calib_ros_view.web.live_page import live_page
    from calib_ros_view.web.source_page import SourcePage

    config, description = configuration(args.config, preset_name=args.preset), read_rig(args.rig)
    out = Path(args.out or OUT)
    check_output(str(out), "--out")
    rig = None
    if args.initial is not None:  # before frames are read for nothing
        found, names = load(args.initial), {sensor.name for sensor in description.sensors}
        if set(found.poses) != names or found.reference != description.reference:
            own = ", ".join(found.poses)
            raise BadInputError(f"{args.initial} is of {own}, not of the sensors of --rig; give a result of this rig")
        rig = of_result(json.loads(Path(args.initial).read_text(encoding="utf-8")), found)
    source = open_rig(args.source, description, **bag_options(args))
    rig = rig or of_priors(description, solve([], priors_of(description, source), description.reference))
    session = RigSession(source, description, rig, config, args.frames, out)

    def opening(camera: str, lidar: str) -> Opened:
        own = session.session(camera, lidar)
        jobs = SessionJobs(own)
        return lambda: SourcePage(own, jobs, pictures, RIG).build(), jobs.close

    yield f"{source.name} · {TITLE}", partial(live_page, session, pictures), opening


@contextmanager
def _of_source(args: argparse.Namespace, pictures: Pictures) -> Iterator[Shown]:
    """A recording of a pair."""
    from calib_ros_view.web.source_page import SourcePage

    config = configuration(args.config, preset_name=args.preset)
    if args.out is not None:
        check_output(args.out, "--out")
    source = open_named_source(args, config)
    initial = args.initial or "reference"
    if initial == "reference" and source.reference is None:
        note(f"{source.name} has no reference extrinsic: the start is the nominal one")
        initial = "nominal"
    start = initial_extrinsic(initial, source, args.yaw_deg)
    positions = frame_positions(args.frames, len(source)) if args.frames else spread_positions(FRAMES, len(source))
    frames = []
    with progress_bar("reading ") as reading:
        for k, position in enumerate(positions):
            frames.append(source[position])
            reading((k + 1) / len(positions))
    with progress_bar("edges   ") as step:
        session = Session(frames, source, start, config, Path(args.out or OUT), Progress(lambda stage, share: step(share)))
    for line in session.scores.notes:
        note(line)
    with closing(SessionJobs(session)) as jobs:
        yield TITLE, lambda: SourcePage(session, jobs, pictures).build(), None
