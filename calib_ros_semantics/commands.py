"""`calib-ros models`, which joins the command line through an entry point. Parsing only: --help must not import what it needs."""

from __future__ import annotations

import argparse
import sys

from calib_ros.cli.arguments import BAD_INPUT, add_source

MODELS = ("segment_anything", "segment_anything_decoder", "image_classes", "cloud_classes")  # of the stage semantics


class ModelsCommand:
    """Which models are configured, whether they load and work, how long they take."""

    help = "test the configured models on a frame: do they load, what do they find, how long do they take"

    def add_arguments(self, command: argparse.ArgumentParser) -> None:
        """See `calib-ros models --help`."""
        add_source(command, "synthetic:frames=1")
        command.add_argument("--frame", type=int, default=0, help="position of the frame (default 0)")
        command.add_argument("--config", metavar="YAML", help="configuration; see the stage semantics of config/calib_ros.yaml")
        for option in MODELS:
            text = f"overrides semantics.{option} of the configuration"
            command.add_argument(f"--{option.replace('_', '-')}", metavar="PATH", help=text)
        command.add_argument("--out", metavar="DIR", help="folder for an image of each model's output")

    def run(self, args: argparse.Namespace) -> int:
        """Try them and tell; 0, 1 for a model whose output cannot be right, 2 for one that cannot be used."""
        from calib_ros.cli.inputs import configuration, open_named_source
        from calib_ros.config import update
        from calib_ros_semantics.cli import models

        named = {option: getattr(args, option) for option in MODELS if getattr(args, option) is not None}
        config = update(configuration(args.config), {"semantics": named})
        lines, failed, doubtful = models(open_named_source(args, config), args.frame, config, args.out)
        print("\n".join(lines))
        for line in (*failed, *doubtful):
            print(f"calib-ros: {line}", file=sys.stderr)
        return BAD_INPUT if failed else 1 if doubtful else 0


MODEL_COMMAND = ModelsCommand()
