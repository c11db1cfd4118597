"""`calib-ros view`: a page in the browser, over a source or a running node."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from functools import partial
from pathlib import Path

from calib_ros.cli.inputs import bag_options, configuration, initial_extrinsic, open_named_source
from calib_ros.cli.output import note, progress_bar
from calib_ros.datasets.positions import frame_positions, spread_positions
from calib_ros.datasets.rig import open_rig
from calib_ros.errors import BadInputError
from calib_ros.io import check_output
from calib_ros.registration.progress import Progress
from calib_ros.rig.description import read_rig
from calib_ros.rig.edges import priors_of
from calib_ros.rig.graph import solve
from calib_ros.runtime import return_freed_memory
from calib_ros_view.session.rig_session import RigSession
from calib_ros_view.session.rig_shown import of_priors, of_result
from calib_ros_view.session.session import Session
from calib_ros_view.web.server import Address, Pictures, listening, require_nicegui, serve

FRAMES = 10  # of a source, unless said otherwise
OUT = "extrinsic.json"
TITLE = "calib-ros view"
PAIR = "/pair/{camera}/{lidar}"  # of a rig
OF_ONE_PAIR = ("yaw_deg", "camera", "image_topic", "points_topic", "camera_info_topic", "rectified")
OF_SOURCES = (
    *("source", "rig", "initial", "yaw_deg", "config", "frames", "out"),
    *("camera", "image_topic", "points_topic", "camera_info_topic", "rectified", "clock", "incomplete"),
)


def view(args: argparse.Namespace) -> None:
    """Serve the page until it is ended. BadInputError for what cannot be shown, or an address that cannot be used."""
    if args.source is None and args.node is None:
        raise BadInputError("nothing to view: name a source (a recording), or a running node with --node /calib_ros")
    require_nicegui()
    return_freed_memory()  # before there are threads: pictures and features of many sizes left gaps of half a gigabyte
    address = Address(args.host, args.port, args.token)
    listening(address).close()  # before frames are read for nothing
    if args.node is not None:
        _view_node(args, address)
        return
    if args.rig is not None:
        _view_rig(args, address)
        return
    session = _session(args)
    from calib_ros_view.session.jobs import SessionJobs
    from calib_ros_view.web.source_page import SourcePage

    jobs, pictures = SessionJobs(session), Pictures()
    ready = partial(_ready, opened=args.open)
    serve(lambda: SourcePage(session, jobs, pictures).build(), TITLE, address, pictures.routes, ready, jobs.close)


def _view_node(args: argparse.Namespace, address: Address) -> None:
    """Serve the page of a running node."""
    given = [name.replace("_", "-") for name in OF_SOURCES if getattr(args, name)]
    if given:
        raise BadInputError(f"--node watches a running node: leave out {', '.join(given)}, which only a source can have")
    from calib_ros_view.node.rig_watch import RigWatch
    from calib_ros_view.node.watch import Watch
    from calib_ros_view.web.live_page import LivePage
    from calib_ros_view.web.pair_pages import RIG, Opened, PairPages
    from calib_ros_view.web.rig_page import RigPage

    pictures = Pictures()
    with Watch(args.node) as watch:
        feed = RigWatch(watch)

        def opening(camera: str, lidar: str) -> Opened:
            if (camera, lidar) not in feed.pairs:
                raise BadInputError(f"{feed.name} has no pair of {camera} and {lidar}; open one that its page lists")
            own = Watch(f"{feed.name}/{camera}/{lidar}")
            return LivePage(own, pictures, RIG).page, own.close

        live, pairs = LivePage(watch, pictures, other=lambda: feed.rig is not None), PairPages(opening)
        serve(
            lambda: live.page() if feed.rig is None else RigPage(feed, pictures).build(),
            *(f"{watch.name} · {TITLE}", address, pictures.routes, partial(_ready, opened=args.open), pairs.close),
            others={PAIR: pairs.page},
        )


def _view_rig(args: argparse.Namespace, address: Address) -> None:
    """Serve the page of a recording of several sensors."""
    given = [name.replace("_", "-") for name in OF_ONE_PAIR if getattr(args, name)]
    if given:
        raise BadInputError(f"--rig says what {', '.join(given)} would: leave them out, and set them in {args.rig}")
    from calib_ros_view.session.jobs import SessionJobs
    from calib_ros_view.web.pair_pages import RIG, Opened, PairPages
    from calib_ros_view.web.rig_page import RigPage
    from calib_ros_view.web.source_page import SourcePage

    config, description = configuration(args.config, preset_name=args.preset), read_rig(args.rig)
    out = Path(args.out or OUT)
    check_output(str(out), "--out")
    rig = None if args.initial is None else of_result(args.initial, description)  # before frames are read for nothing
    source = open_rig(args.source, description, **bag_options(args))
    rig = rig or of_priors(description, solve([], priors_of(description, source), description.reference))
    pictures, session = Pictures(), RigSession(source, description, rig, config, args.frames, out)

    def opening(camera: str, lidar: str) -> Opened:
        own = session.session(camera, lidar)
        jobs = SessionJobs(own)
        return lambda: SourcePage(own, jobs, pictures, RIG).build(), jobs.close

    pairs, ready = PairPages(opening), partial(_ready, opened=args.open)
    build, title = lambda: RigPage(session, pictures).build(), f"{source.name} · {TITLE}"
    serve(build, title, address, pictures.routes, ready, pairs.close, {PAIR: pairs.page})


def _session(args: argparse.Namespace) -> Session:
    """Frames, their edges, and the start."""
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
    return session


def _ready(url: str, opened: bool) -> None:
    print(f"open {url} (Ctrl-C ends)", flush=True)
    if opened and not webbrowser.open(url):
        print("no browser found here", file=sys.stderr)
