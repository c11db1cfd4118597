"""The command `calib-ros`: parse, call, print."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

from calib_ros.errors import CalibrationError

OK, NOT_CONVERGED, BAD_INPUT = 0, 1, 2


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> Any:
        """One line instead of the whole usage."""
        self.exit(BAD_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="calib-ros", description="Targetless camera-LiDAR extrinsic calibration, once or while driving.")
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)

    def add(name: str, run: Callable[[argparse.Namespace], int], text: str, source: bool = True) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text)
        command.set_defaults(run=run)
        if source:
            command.add_argument(
                "source", help="KITTI raw/odometry/object folder, ROS 2 bag, or synthetic[:seed=3,frames=16,rings=32,...]"
            )
            command.add_argument("--camera", type=int, default=2, help="KITTI camera 0-3 (default 2)")
            for topic in ("image", "points", "camera-info"):
                command.add_argument(f"--{topic}-topic", help="topic of a bag that holds several of the kind")
        return command

    command = add(
        "demo", _demo, "the main job on the embedded synthetic drive: bag, node and player over DDS, result", source=False
    )
    command.add_argument("--out", default="demo_out", help="folder for bag, pictures and result (default demo_out)")
    command.add_argument("--seed", type=int, default=0, help="which street, and which wrong start")

    add("info", _info, "what the source holds")

    command = add("calibrate", _calibrate, "estimate the extrinsic from the frames of a source")
    _frames_and_start(command)
    command.add_argument("--search-deg", type=float, help="half width of the search box, deg; 0 with --search-m 0 = refine only")
    command.add_argument("--search-m", type=float, help="half width of the search box, m")
    command.add_argument("--objective", choices=["fast", "thesis"], help="score to maximise (default fast); thesis = eq. 3.12")
    command.add_argument("--overlay", metavar="PNG", help="write a before/after picture of the middle frame")
    command.add_argument("--json", metavar="FILE", help="write the result as JSON (YAML if FILE ends so); - = standard output")
    command.add_argument("--seed", type=int, help="seed of the search")

    command = add("convert", _convert, "write a source as a ROS 2 bag")
    command.add_argument("bag", help="folder to make")
    command.add_argument("--frames", default="all", help="all, 0,4,8 or 0:100:5")
    command.add_argument("--storage", default="mcap", choices=["mcap", "sqlite3"])

    command = add("replay", _replay, "the online recalibrator over a source, without ROS; a JSON line per estimate")
    _frames_and_start(command)

    command = add("steps", _steps, "every intermediate picture of the method for one frame, as a page")
    command.add_argument("--frame", type=int, default=0, help="position as info lists them (default 0)")
    command.add_argument("--out", default="steps_out", help="folder for pictures and index.html (default steps_out)")
    command.add_argument("--initial", help="nominal, reference, or a result file (default reference if there is one)")
    _yaw_and_config(command)

    command = add("play", _play, "publish a bag over ROS", source=False)
    command.add_argument("bag")
    command.add_argument("--rate", type=float, default=1.0, help="times the recorded pace (default 1)")
    command.add_argument("--loop", action="store_true", help="start over at the end")
    command.add_argument("--clock", action="store_true", help="publish /clock for use_sim_time")
    command.add_argument("--wait", type=float, default=10.0, help="seconds to wait for subscribers (default 10)")
    return parser


def _frames_and_start(command: argparse.ArgumentParser) -> None:
    command.add_argument("--frames", default="all", help="all, 0,4,8 or 0:100:5 (positions as info lists them)")
    command.add_argument("--initial", default="nominal", help="nominal, reference, or a result file (default nominal)")
    _yaw_and_config(command)


def _yaw_and_config(command: argparse.ArgumentParser) -> None:
    command.add_argument("--yaw-deg", type=float, default=0.0, help="nominal looks this far to the left of the LiDAR's +x axis")
    command.add_argument("--config", metavar="YAML", help="configuration; see config/calib_ros.yaml")


def _open(args: argparse.Namespace) -> Any:
    from calib_ros.datasets import open_source

    topics = {"image_topic": args.image_topic, "points_topic": args.points_topic, "camera_info_topic": args.camera_info_topic}
    return open_source(args.source, camera=args.camera, **{name: topic for name, topic in topics.items() if topic})


def _demo(args: argparse.Namespace) -> int:
    from calib_ros.demo import run

    return OK if run(args.out, args.seed) else NOT_CONVERGED


def _info(args: argparse.Namespace) -> int:
    from calib_ros.report import describe

    print(describe(_open(args)))
    return OK


def _calibrate(args: argparse.Namespace) -> int:
    from calib_ros import commands, report

    source = _open(args)
    result = commands.calibrate(
        source,
        args.frames,
        args.initial,
        args.yaw_deg,
        commands.configuration(args.config, args.seed, args.objective),
        args.search_deg,
        args.search_m,
        args.overlay,
    )
    if args.json == "-":
        print(result.dumps(), end="")
    elif args.json:
        result.save(args.json)
    text = report.summary(result)
    print(text, file=sys.stderr if args.json == "-" else sys.stdout)
    return OK if result.converged else NOT_CONVERGED


def _convert(args: argparse.Namespace) -> int:
    from calib_ros import commands

    print(commands.convert(_open(args), args.bag, args.frames, args.storage))
    return OK


def _replay(args: argparse.Namespace) -> int:
    import json

    from calib_ros import commands

    source = _open(args)
    converged = False
    for line in commands.replay(source, args.frames, args.initial, args.yaw_deg, commands.configuration(args.config)):
        print(json.dumps(line), flush=True)
        converged = line["status"] == "converged"
    return OK if converged else NOT_CONVERGED


def _steps(args: argparse.Namespace) -> int:
    import shlex

    from calib_ros import commands

    # Not sys.argv, nor the output folder: the same input gives the same page.
    command = ["calib-ros", "steps", args.source, "--frame", str(args.frame)]
    command += ["--camera", str(args.camera)] if args.camera != 2 else []
    for option in ("initial", "config", "image_topic", "points_topic", "camera_info_topic"):
        value = getattr(args, option)
        command += [f"--{option.replace('_', '-')}", value] if value else []
    command += ["--yaw-deg", f"{args.yaw_deg:g}"] if args.yaw_deg else []
    config = commands.configuration(args.config)
    print(commands.steps(_open(args), args.frame, args.initial, args.yaw_deg, config, args.out, shlex.join(command)))
    return OK


def _play(args: argparse.Namespace) -> int:
    from calib_ros import commands

    try:
        from calib_ros.ros.player import PlayOptions, play
    except ImportError as error:
        raise CalibrationError(
            f"playing needs ROS 2 ({error.name} is missing); source your ROS install or run make env"
        ) from None
    options = PlayOptions(args.rate, args.loop, args.clock, args.wait)
    with commands.progress_bar("playing") as step:
        counts = play(args.bag, options, lambda text: print(text, file=sys.stderr), step)
    for topic, count in counts.items():
        print(f"{count:7d}  {topic}")
    return OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0 converged or done, 1 not converged, 2 bad input."""
    parser = _parser()
    args = parser.parse_args(argv)
    if args.version or args.command is None:
        from calib_ros import __version__

        print(f"calib-ros {__version__}")
        if not args.version:
            parser.print_help()
        return OK if args.version else BAD_INPUT
    try:
        return int(args.run(args))
    except CalibrationError as error:
        print(f"calib-ros: {error}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        if isinstance(error, BrokenPipeError):  # the reader, for instance `head`, has seen enough
            sys.stderr.close()
            return OK
        print(f"calib-ros: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("calib-ros: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
