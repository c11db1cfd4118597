"""`calib-ros view`: a page in the browser, over a source or a running node."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from functools import partial
from pathlib import Path

from calib_ros.cli.inputs import configuration, initial_extrinsic, open_named_source
from calib_ros.cli.output import note, progress_bar
from calib_ros.datasets.positions import frame_positions, spread_positions
from calib_ros.errors import BadInputError
from calib_ros.io import check_output
from calib_ros.registration.progress import Progress
from calib_ros.runtime import return_freed_memory
from calib_ros_view.session.session import Session
from calib_ros_view.web.server import Address, Pictures, listening, require_nicegui, serve

FRAMES = 10  # of a source, unless said otherwise
OUT = "extrinsic.json"
TITLE = "calib-ros view"
OF_SOURCES = (
    *("source", "initial", "yaw_deg", "config", "frames", "out"),
    *("camera", "image_topic", "points_topic", "camera_info_topic", "clock", "incomplete"),
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
    from calib_ros_view.node.watch import Watch
    from calib_ros_view.web.live_page import LivePage

    with Watch(args.node) as watch:
        live = LivePage(watch)
        serve(live.page, f"{watch.name} · {TITLE}", address, live.routes, partial(_ready, opened=args.open))


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
