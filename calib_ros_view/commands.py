"""`calib-ros view`, which joins the command line through an entry point. Parsing only: --help must not import what it needs."""

from __future__ import annotations

import argparse

from calib_ros.cli.arguments import SOURCE, add_camera_and_topics, add_yaw_and_config


class ViewCommand:
    """A page in the browser, over a source or a running node."""

    help = "look at an extrinsic, move it by hand, refine and save it, on a page in the browser"

    def add_arguments(self, command: argparse.ArgumentParser) -> None:
        """See `calib-ros view --help`."""
        command.add_argument("source", nargs="?", help=f"{SOURCE}; or --node")
        add_camera_and_topics(command)
        command.add_argument("--node", metavar="NAME", help="watch a running node instead, for example /calib_ros")
        command.add_argument("--rig", metavar="FILE", help="all sensors of a rig that this YAML file describes, see docs/rig.md")
        command.add_argument(
            "--initial",
            help="where to start: reference (default), nominal, or a result file; nominal if there is no reference. "
            "With --rig a result of calib-ros rig (default: the priors)",
        )
        add_yaw_and_config(command)
        command.add_argument("--frames", help="all, 0,4,8 or 0:100:5 (default: ten, evenly spread)")
        command.add_argument("--out", metavar="FILE", help="where Save writes (default extrinsic.json)")
        command.add_argument("--port", type=int, default=8765, help="of the page (default 8765); 0 = any free one")
        command.add_argument("--host", default="127.0.0.1", help="to serve on (default this machine only; else with a token)")
        command.add_argument("--token", help="that opens the page; default: none on this machine, else a random one")
        command.add_argument("--open", action="store_true", help="open the page in the browser of this machine")

    def run(self, args: argparse.Namespace) -> int:
        """Serve the page until it is ended; 0."""
        from calib_ros_view.cli import view

        view(args)
        return 0


VIEW = ViewCommand()
