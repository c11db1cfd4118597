"""`calib-ros view`: a page in the browser over a source."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from pathlib import Path

from calib_ros.cli.inputs import configuration, initial_extrinsic, open_named_source
from calib_ros.cli.output import note, progress_bar
from calib_ros.datasets.positions import frame_positions, spread_positions
from calib_ros.registration.progress import Progress
from calib_ros.view.session import Session
from calib_ros.web.server import Address, listening, require_nicegui, serve

FRAMES = 10  # of a source, unless said otherwise
TITLE = "calib-ros view"


def view(args: argparse.Namespace) -> None:
    """Serve the page until it is ended. BadInputError for what cannot be shown, or an address that cannot be used."""
    require_nicegui()
    address = Address(args.host, args.port, args.token)
    listening(address).close()  # before frames are read for nothing
    session = _session(args)
    from calib_ros.view.jobs import Jobs
    from calib_ros.web.pictures import Pictures
    from calib_ros.web.source_page import page_of

    jobs, pictures = Jobs(session), Pictures()
    page = page_of(session, jobs, pictures)
    serve(page, TITLE, address, pictures.routes, lambda url: _ready(url, args.open), jobs.close)


def _session(args: argparse.Namespace) -> Session:
    """Frames, their edges, and the start."""
    config = configuration(args.config)
    source = open_named_source(args, config)
    initial = args.initial
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
        session = Session(frames, source, start, config, Path(args.out), Progress(lambda stage, share: step(share)))
    for line in session.scores.notes:
        note(line)
    return session


def _ready(url: str, opened: bool) -> None:
    print(f"open {url} (Ctrl-C ends)", flush=True)
    if opened and not webbrowser.open(url):
        print("no browser found here", file=sys.stderr)
