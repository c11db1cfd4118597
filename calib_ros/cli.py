"""The command `calib-ros`: parse, call, print."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from typing import Any

from calib_ros.commands.arguments import BAD_INPUT, parser
from calib_ros.errors import BadInputError, CalibrationError

OK, NOT_CONVERGED = 0, 1


def _open(args: argparse.Namespace) -> Any:
    from calib_ros.datasets import open_source

    return open_source(args.source, camera=args.camera, **_topics(args))


def _topics(args: argparse.Namespace) -> dict[str, str]:
    names = ("image_topic", "points_topic", "camera_info_topic")
    return {name: getattr(args, name) for name in names if getattr(args, name)}


def _known(args: argparse.Namespace) -> Any:
    from calib_ros.commands.knowledge import Knowledge

    return Knowledge(args.rotation_only, args.fix, args.bound, args.prior_deg, args.prior_m, args.time_offset_ms)


def _demo(args: argparse.Namespace) -> int:
    from calib_ros.demo import run

    return OK if run(args.out, args.seed) else NOT_CONVERGED


def _info(args: argparse.Namespace) -> int:
    from calib_ros.report import describe

    print(describe(_open(args)))
    return OK


def _calibrate(args: argparse.Namespace) -> int:
    from calib_ros import commands, report

    known = _known(args)
    known.check_search(args.search_deg, args.search_m)
    config = commands.configuration(args.config, args.seed, args.objective, known)
    result = commands.calibrate(
        _open(args), args.frames, args.initial, args.yaw_deg, config, args.search_deg, args.search_m, args.overlay
    )
    if args.json == "-":
        print(result.dumps(), end="")
    elif args.json:
        result.save(args.json)
    print(report.summary(result), file=sys.stderr if args.json == "-" else sys.stdout)
    return OK if result.converged else NOT_CONVERGED


def _convert(args: argparse.Namespace) -> int:
    from calib_ros import commands

    print(commands.convert(_open(args), args.bag, args.frames, args.storage))
    return OK


def _replay(args: argparse.Namespace) -> int:
    import json

    from calib_ros import commands

    config = commands.configuration(args.config, known=_known(args))
    converged = False
    for line in commands.replay(_open(args), args.frames, args.initial, args.yaw_deg, config):
        print(json.dumps(line), flush=True)
        converged = line["status"] == "converged"
    return OK if converged else NOT_CONVERGED


def _steps(args: argparse.Namespace) -> int:
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


def _evaluate(args: argparse.Namespace) -> int:
    from calib_ros import commands

    if args.compare:
        if args.source:
            raise BadInputError("--compare takes two tables of earlier evaluations; leave the sources out")
        print(commands.compared(*args.compare))
        return OK
    if not args.source:
        raise BadInputError("give at least one source, or --compare A.csv B.csv")
    given = {name: value for name, value in vars(args).items() if name in commands.Asked.__dataclass_fields__}
    command = shlex.join(["calib-ros", *args.given])
    given |= {"command": command, "config": commands.configuration(args.config), "topics": tuple(_topics(args).items())}
    print(commands.run_evaluation(commands.Asked(**given)))
    return OK


def _models(args: argparse.Namespace) -> int:
    from calib_ros import commands
    from calib_ros.commands.arguments import MODELS
    from calib_ros.config import update

    named = {option: getattr(args, option) for option in MODELS if getattr(args, option) is not None}
    config = update(commands.configuration(args.config), {"semantics": named})
    lines, works = commands.models(_open(args), args.frame, config, args.out)
    print("\n".join(lines))
    return OK if works else NOT_CONVERGED


def _export(args: argparse.Namespace) -> int:
    from calib_ros import commands

    print(commands.export(args.file, args.format, args.parent, args.camera_frame, args.lidar_frame, args.out), end="")
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


_RUN = {
    "demo": _demo,
    "info": _info,
    "calibrate": _calibrate,
    "convert": _convert,
    "replay": _replay,
    "steps": _steps,
    "evaluate": _evaluate,
    "models": _models,
    "export": _export,
    "play": _play,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0 converged or done, 1 not converged, 2 bad input."""
    options = parser()
    args = options.parse_args(argv)
    args.given = list(sys.argv[1:] if argv is None else argv)
    if args.version or args.command is None:
        from calib_ros import __version__

        print(f"calib-ros {__version__}")
        if not args.version:
            options.print_help()
        return OK if args.version else BAD_INPUT
    try:
        return _RUN[args.command](args)
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
