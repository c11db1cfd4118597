"""`calib-ros evaluate` and `calib-ros steps`, which join the command line through entry points.

Parsing only: --help must not import the libraries that the commands need.
"""

from __future__ import annotations

import argparse

from calib_ros.cli.arguments import SOURCE, add_camera_and_topics, add_preset, add_source, add_yaw_and_config
from calib_ros.errors import BadInputError, MissingDependencyError


class Steps:
    """Every intermediate picture of the method for one frame."""

    help = "every intermediate picture of the method for one frame, as a page"

    def add_arguments(self, command: argparse.ArgumentParser) -> None:
        """See `calib-ros steps --help`."""
        add_source(command)
        command.add_argument("--frame", type=int, default=0, help="position as info lists them (default 0)")
        command.add_argument("--out", default="steps_out", help="folder for pictures and index.html (default steps_out)")
        command.add_argument("--initial", help="nominal, reference, or a result file (default reference if there is one)")
        add_yaw_and_config(command)

    def run(self, args: argparse.Namespace) -> int:
        """Write the page; 0."""
        from calib_ros_evaluation.steps.command import run_steps

        print(run_steps(args))
        return 0


class Evaluate:
    """The experiments of the thesis and more, on any source with a known extrinsic."""

    help = "compare methods: loss curves, errors, run times on sources with a known extrinsic"

    def add_arguments(self, command: argparse.ArgumentParser) -> None:
        """See `calib-ros evaluate --help`."""
        command.add_argument("source", nargs="*", help=f"{SOURCE}; or a folder that holds several; any number")
        add_camera_and_topics(command)
        command.add_argument("--out", default="evaluation_out", help="folder for report and tables (default evaluation_out)")
        command.add_argument("--quick", action="store_true", help="a few of everything, to see how it looks")
        command.add_argument("--frames", default="all", help="of each source: all, 0,4,8 or 0:100:5")
        command.add_argument("--methods", type=_names, metavar="A,B", help="only these (default all)")
        command.add_argument("--experiments", type=_names, metavar="A,B", help="only these (default all)")
        command.add_argument("--start-deg", type=float, metavar="S", help="size of the start error per axis, deg (default 2)")
        command.add_argument("--start-m", type=float, metavar="S", help="the same, m (default 0.2)")
        command.add_argument("--repeats", type=int, metavar="N", help="starts per single frame (default 1)")
        command.add_argument("--seed", type=int, help="of the starts (default 0)")
        command.add_argument("--reference", metavar="FILE", help="result file that counts as true, instead of the sources' own")
        command.add_argument("--config", metavar="YAML", help="configuration of all methods; see config/calib_ros.yaml")
        add_preset(command)
        command.add_argument("--workers", type=int, metavar="N", help="processes (default one per core)")
        command.add_argument(
            "--scheduler", metavar="ADDRESS", help="of a running Dask cluster, as tcp://host:8786, to work there"
        )
        command.add_argument("--fresh", action="store_true", help="forget what the folder holds; default is to go on with it")
        command.add_argument("--protocol", metavar="NAME", help="published: projfusion, miscalibration, borer or unicalib")
        command.add_argument("--frames-per-trial", type=_counts, metavar="A,B", help="of --protocol (default 1,3,5,10)")
        command.add_argument("--trials", type=int, metavar="N", help="of --protocol, per start error and frames (default 100)")
        command.add_argument("--table", metavar="CSV", help="published perturbations of --protocol miscalibration")
        command.add_argument("--compare", nargs=2, metavar=("A.csv", "B.csv"), help="instead: trials.csv of two versions, paired")

    def run(self, args: argparse.Namespace) -> int:
        """Evaluate, or compare two evaluations; 0."""
        if args.compare and args.source:
            raise BadInputError("--compare takes two tables of earlier evaluations; leave the sources out")
        if not args.compare and not args.source:
            raise BadInputError("give at least one source, or --compare A.csv B.csv")
        if args.protocol and args.compare:
            raise BadInputError("--protocol runs trials, --compare reads those of two evaluations; give one of them")
        try:
            from calib_ros_evaluation.commands import run_evaluation
        except ModuleNotFoundError as error:
            if error.name != "pandas":
                raise
            raise MissingDependencyError("the tables need pandas: pip install pandas, or apt install python3-pandas") from None
        print(run_evaluation(args))
        return 0


STEPS, EVALUATE = Steps(), Evaluate()


def _counts(text: str) -> tuple[int, ...]:
    """'1,3' -> the numbers, ascending."""
    try:
        found = sorted({int(part) for part in text.split(",")})
    except ValueError:
        found = [0]
    if found[0] < 1:
        raise argparse.ArgumentTypeError(f"'{text}': give whole numbers of at least 1, separated by commas")
    return tuple(found)


def _names(text: str) -> tuple[str, ...]:
    """'a,b' -> the names."""
    found = tuple(name.strip() for name in text.split(",") if name.strip())
    if not found:
        raise argparse.ArgumentTypeError("give names separated by commas")
    return tuple(dict.fromkeys(found))
