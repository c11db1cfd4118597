"""The command `calib-ros`: parse, call, print."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

from calib_ros import extensions
from calib_ros.cli.arguments import BAD_INPUT, parser
from calib_ros.errors import BadInputError, CalibrationError

OK, NOT_CONVERGED = 0, 1
# Libraries that only some commands need, and how to get them.
OPTIONAL = {"rosbags": "python3 -m pip install rosbags", "rclpy": "source your ROS install or pip install 'calib_ros[ros]'"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0 converged or done, 1 not converged, 2 bad input."""
    given = list(sys.argv[1:] if argv is None else argv)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _print_warning
            code = _run(given)
            if sys.stdout is not None:  # as of a service without one
                sys.stdout.flush()
            return code
    except BrokenPipeError:  # the reader, for instance `head`, has seen enough
        from calib_ros.cli.output import discard_output

        discard_output()
        return OK
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        advice = "install it from the repository of calib_ros" if library.startswith("calib_ros_") else OPTIONAL.get(library)
        if advice is None:
            raise
        print(f"calib-ros: '{given[0]}' needs {library}: {advice}", file=sys.stderr)
        return BAD_INPUT
    except (CalibrationError, OSError) as error:
        print(f"calib-ros: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("calib-ros: interrupted", file=sys.stderr)
        return 130


def _run(given: Sequence[str]) -> int:
    """The command that is given, or the version."""
    others = extensions.commands()
    options = parser(others)
    args = options.parse_args(given)
    args.given = given
    if args.version or args.command is None:
        from calib_ros import __version__

        print(f"calib-ros {__version__}")
        if not args.version:
            options.print_help()
        return OK if args.version else BAD_INPUT
    return _RUN[args.command](args) if args.command in _RUN else others[args.command].run(args)


def _print_warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object, **__: object) -> None:
    """Print our notes to the user, such as a renamed parameter, in one line; other warnings as Python writes them."""
    ours = category is FutureWarning and "calib_ros" in filename
    print(f"calib-ros: {message}" if ours else warnings.formatwarning(message, category, filename, lineno), file=sys.stderr)


def _info(args: argparse.Namespace) -> int:
    from calib_ros.cli.inputs import open_named_source
    from calib_ros.cli.output import describe

    print(describe(open_named_source(args)))
    return OK


def _calibrate(args: argparse.Namespace) -> int:
    from calib_ros.cli.calibrate import advice, calibrate, next_command
    from calib_ros.cli.inputs import configuration, constraint_options, initial_of, open_named_source
    from calib_ros.cli.output import check_json, checked_by, note, print_or_save, summary
    from calib_ros.config.sensors import REFINE
    from calib_ros.datasets.source import frame_positions
    from calib_ros.intrinsics import camera_info_yaml
    from calib_ros.io import check_output, write_atomically

    constraints = constraint_options(args)
    constraints.check_free("--search", args.search_deg, args.search_m, "the search")
    check_json(args.json)
    config = configuration(args.config, args.seed, args.objective, constraints, args.threads, args.intrinsics, args.preset)
    args.initial = initial_of(args, config)
    if args.camera_info is not None:
        if config.camera.intrinsics != REFINE:
            raise BadInputError("--camera-info writes refined intrinsics: give --intrinsics refine as well, or leave it out")
        check_output(args.camera_info, "--camera-info")
    source = open_named_source(args, config)
    cameras = getattr(source, "cameras", ())
    if len(cameras) > 1 and args.camera is None:
        names = ", ".join(cameras)
        note(f"calib-ros: the recording has cameras {names}; --camera chooses one, calib-ros rig estimates all together")
    limits = args.search_deg, args.search_m
    result = calibrate(source, args.frames, args.initial, args.yaw_deg, config, *limits, args.overlay)
    told = advice(result, source, config), next_command(result, source, config, args)
    then = "\n" + checked_by(args.given, args.json, frame_positions(args.frames, len(source)), len(source))
    print_or_save(result, summary(result, *told, args.initial) + then * (result.converged and args.json != "-"), args.json)
    if args.camera_info is not None and result.converged and result.refined_camera is not None:
        write_atomically(args.camera_info, camera_info_yaml(result.refined_camera.camera, result.camera_frame).encode())
    elif args.camera_info is not None:
        note(f"{args.camera_info} is not written: the estimate is {result.status}")
    return OK if result.converged else NOT_CONVERGED


def _rig(args: argparse.Namespace) -> int:
    from calib_ros.cli.inputs import configuration
    from calib_ros.cli.output import check_json, note, page, print_or_save, progress_bar
    from calib_ros.datasets.open import open_rig
    from calib_ros.datasets.rig import rig_yaml
    from calib_ros.io import check_output, write_atomically
    from calib_ros.rig.description import read_rig
    from calib_ros.rig.edges import RigMeasurer
    from calib_ros.rig.recorded import joined, recorded_rig
    from calib_ros.rig.report import RigReport, check_out, load

    before = None if args.before is None else load(args.before)
    config = configuration(args.config, args.seed)
    check_json(args.json)
    write_page = page("rig", args.report)
    if args.write_rig is not None:
        check_output(args.write_rig, "--write-rig")
    for path in args.out:
        check_out(path)
        check_output(path, "--out")
    if args.rig is not None:
        if args.write_rig is not None:
            raise BadInputError(f"--write-rig {args.write_rig} writes what is assumed without --rig; leave one of them out")
        description = read_rig(args.rig)
        rig = open_rig(args.source, description)
    else:
        description, rig, remarks = recorded_rig(args.source)
        if args.write_rig is not None:
            write_atomically(args.write_rig, rig_yaml(description).encode())
        description = joined(description, args.source, remarks)
        note("\n".join(f"calib-ros: {remark}" for remark in remarks))
    if before is not None and set(before.poses) != {sensor.name for sensor in description.sensors}:
        names = ", ".join(before.poses)
        raise BadInputError(
            f"--before {args.before} is of other sensors ({names}) than {args.rig or args.source}; give a result of this rig"
        )
    with progress_bar("measuring") as step:
        measurer = RigMeasurer(rig, description, config, args.frames, lambda text, share: step(share))
        measured = measurer.measure()
    report = RigReport.of(measurer, measured, before)
    print_or_save(report, report.text(), args.json)
    if write_page is not None:
        write_page(report, measurer)
    for path in args.out:
        if remark := report.write(path):
            note(f"calib-ros: {remark}")
    return OK if report.converged else NOT_CONVERGED


def _convert(args: argparse.Namespace) -> int:
    from calib_ros.cli.inputs import open_named_source
    from calib_ros.cli.output import progress_bar
    from calib_ros.datasets.bag_writer import write_bag, write_rig_bag
    from calib_ros.datasets.open import named_rig
    from calib_ros.datasets.source import frame_positions

    rig = named_rig(args.source) if args.camera is None else None
    if rig is not None:
        if args.frames != "all":
            raise BadInputError(f"--frames {args.frames} does not go with a rig, which is written as a whole; make it shorter")
        with progress_bar("writing") as step:
            path, described = write_rig_bag(rig, args.bag, args.storage, step)
        print(f"{len(rig.cameras)} cameras and {len(rig.lidars)} LiDARs written to {path}, described by {described}")
        return OK
    source = open_named_source(args)
    positions = frame_positions(args.frames, len(source))
    with progress_bar("writing") as step:
        path = write_bag(source, args.bag, args.storage, positions, step)
    print(f"{len(positions)} frames written to {path}; play them with: calib-ros play {path}")
    return OK


def _replay(args: argparse.Namespace) -> int:
    import json

    from calib_ros.cli.calibrate import replay
    from calib_ros.cli.inputs import configuration, constraint_options, initial_of, open_named_source
    from calib_ros.cli.output import page
    from calib_ros.result import CONVERGED, TENTATIVE

    config = configuration(args.config, constraints=constraint_options(args), preset_name=args.preset)
    args.initial = initial_of(args, config)
    write_film, converged = page("gif", args.gif), False
    for line in replay(open_named_source(args, config), args.frames, args.initial, args.yaw_deg, config, write_film):
        print(json.dumps(line), flush=True)
        converged = line["status"] in (CONVERGED, TENTATIVE)
    return OK if converged else NOT_CONVERGED


def _export(args: argparse.Namespace) -> int:
    """What is not an accepted estimate is exported with a note, since initial extrinsics are exported as well."""
    from calib_ros.cli.output import note
    from calib_ros.export import DESCRIPTIONS, export, poses_of, renamed, write_edges
    from calib_ros.io import write_atomically
    from calib_ros.online.state import read_state

    state = read_state(args.file)
    result = state.result
    text = export(result, args.format, args.parent, state.camera, args.camera_frame, args.lidar_frame)
    if not result.converged:
        why = f" ({' '.join(result.reason.split())})" if result.reason else ""
        note(f"calib-ros: {args.file} is not an accepted estimate, its status is {result.status}{why}; exported all the same")
    if args.format == "kitti" and state.camera is not None and not state.camera.is_pinhole:
        note("calib-ros: no P0 written, the camera has distortion; Tr holds for its rectified image, too")
    if args.out is None or args.out == "-":
        print(text, end="")
    elif args.format == "urdf" and Path(args.out).suffix.lower() in DESCRIPTIONS and Path(args.out).exists():
        write_edges(args.out, poses_of(renamed(result, args.camera_frame, args.lidar_frame), "camera", "lidar"), {})
        print(f"changed the joint between the sensors in {args.out}")
    else:
        write_atomically(args.out, text.encode())
        what = ": a joint alone, not a description; put it between the <robot> tags of one that has both links"
        print(f"wrote {args.out}{what if args.format == 'urdf' else ''}")
    return OK


def _play(args: argparse.Namespace) -> int:
    from calib_ros.cli.output import progress_bar
    from calib_ros.ros.bags import play

    options = args.rate, args.loop, args.clock, args.wait, args.follow
    with progress_bar("playing") as step:
        counts = play(args.bag, lambda text: print(text, file=sys.stderr), step, *options)
    for topic, count in counts.items():
        print(f"{count:7d}  {topic}")
    return OK


_RUN = {own.__name__[1:]: own for own in (_info, _calibrate, _rig, _convert, _replay, _export, _play)}


if __name__ == "__main__":
    sys.exit(main())
