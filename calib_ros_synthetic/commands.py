"""`calib-ros demo`, which joins the command line through an entry point. Parsing only: --help must not import what it needs."""

from __future__ import annotations

import argparse

from calib_ros.cli.arguments import add_preset


class Demo:
    """The main job on the built-in synthetic drive, with real processes."""

    help = "calibrate a built-in synthetic drive with the real node: bag, player and node over DDS"

    def add_arguments(self, command: argparse.ArgumentParser) -> None:
        """See `calib-ros demo --help`."""
        command.add_argument("--out", default="demo_out", help="folder for bag, pictures and result (default demo_out)")
        command.add_argument("--seed", type=int, default=0, help="seed of the street and of the wrong start")
        command.add_argument("--gif", metavar="FILE", help="a moving picture of the drive, replayed, of at most 2 MB")
        add_preset(command)

    def run(self, args: argparse.Namespace) -> int:
        """Run it; 0 if the extrinsic was recovered, else 1."""
        from calib_ros_synthetic.demo import run

        return 0 if run(args.out, args.seed, args.preset, args.gif) else 1


DEMO = Demo()
