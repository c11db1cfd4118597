"""`calib-ros check`, which joins the command line through an entry point. Parsing only: --help must not import what it needs."""

from __future__ import annotations

import argparse

from calib_ros.cli.arguments import SOURCE, add_camera_and_topics


def add_check_options(command: argparse.ArgumentParser) -> None:
    """How each extrinsic is checked."""
    for option, default, unit in (("--tolerance-deg", 0.5, "deg"), ("--tolerance-m", 0.1, "m")):
        command.add_argument(
            option, type=float, default=default, help=f"error up to which it is right, {unit} (default {default})"
        )
    command.add_argument("--config", metavar="YAML", help="configuration; see config/calib_ros.yaml")


def add_workers(group: argparse._ActionsContainer, out: str) -> None:
    """Where the work is done, and what it leaves."""
    group.add_argument("--out", default=out, help=f"folder for page, tables and journal (default {out})")
    group.add_argument("--workers", type=int, metavar="N", help="processes (default one per core)")
    group.add_argument("--scheduler", metavar="ADDRESS", help="of a running Dask cluster, as tcp://host:8786, to work there")
    group.add_argument("--fresh", action="store_true", help="forget what the folder holds; default is to go on with it")


class Check:
    """Is the extrinsic of a recording, or of a fleet's recordings, right?"""

    help = "is the extrinsic of a recording right? exit code 0 = pass, 1 = fail, 3 = inconclusive"

    def add_arguments(self, command: argparse.ArgumentParser) -> None:
        """See `calib-ros check --help`."""
        command.add_argument("source", nargs="+", help=f"{SOURCE}; several, or a folder of recordings, are a fleet")
        add_camera_and_topics(command)
        command.add_argument(
            *("--extrinsic", "--initial"),
            default="reference",
            metavar="WHAT",
            help="what is checked: reference = of the source (default), tf = the static transforms of a bag, or a result file",
        )
        command.add_argument(
            "--rig", metavar="YAML", help="several cameras and LiDARs, as for `calib-ros rig`; --extrinsic may be its JSON result"
        )
        command.add_argument("--frames", help="all, 0,4,8 or 0:100:5 (default: ten, evenly spread)")
        add_check_options(command)
        command.add_argument("--json", metavar="FILE", help="write the result as JSON; - = to standard output")
        command.add_argument("--report", metavar="HTML", help="write a page: size of the error, other causes, pictures")
        command.add_argument("--verbose", action="store_true", help="say what the stages took of the CPU time")
        command.add_argument("--overlay", help=argparse.SUPPRESS)
        group = command.add_argument_group(
            "fleets", "Several recordings, or a folder of them: a table, a page, and which vehicles changed."
        )
        add_workers(group, "check_out")
        group.add_argument(
            "--vehicle-pattern",
            metavar="REGEX",
            help="with a group (?P<vehicle>...) that is searched for in each path (default: the folder that a recording lies in)",
        )
        group.add_argument(
            "--false-alarms",
            type=float,
            default=0.001,
            metavar="RATE",
            help="changes reported per recording where there is none (default 0.001)",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Check and tell; the exit code."""
        from calib_ros_check.cli import check_many, check_one, is_one

        return check_one(args) if is_one(args.source, args.rig) else check_many(args)


class Certify:
    """Is every calibration of a data set right?"""

    help = "is every calibration of a data set right? A page and a table; exit code as of check"

    def add_arguments(self, command: argparse.ArgumentParser) -> None:
        """See `calib-ros certify --help`."""
        command.add_argument(
            "source", nargs="+", help="folders of KITTI, KITTI-360, nuScenes, View of Delft, ONCE, plain recordings, bags"
        )
        command.add_argument("--camera", help="only this one, by its name or number (default: every camera of a recording)")
        command.add_argument(
            "--frames", type=int, default=10, metavar="N", help="of each calibration in a recording, evenly spread (default 10)"
        )
        add_check_options(command)
        add_workers(command, "certify_out")

    def run(self, args: argparse.Namespace) -> int:
        """Certify and tell; the exit code."""
        from calib_ros_check.cli import certify_many

        return certify_many(args)


CHECK, CERTIFY = Check(), Certify()
