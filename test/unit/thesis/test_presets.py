"""The thesis's own system by one word: what the presets set, and what holds before them."""

from __future__ import annotations

import dataclasses

import pytest

from calib_ros.cli.arguments import parser
from calib_ros.cli.inputs import configuration, initial_of
from calib_ros.config import Config, load_stages, preset, update
from calib_ros.extensions import commands
from calib_ros_thesis.config import ThesisConfig
from calib_ros_thesis.presets import LITERAL, THESIS


def test_the_thesis_is_chosen_whole():
    config = preset("thesis")
    assert (config.refine.objective, config.refine.optimizer) == ("thesis", "nelder_mead")
    assert config.semantics.frame_weights
    assert not config.semantics.in_doubt_only
    assert config.stage(ThesisConfig).dense_edges == "once_per_level"


def test_the_literal_one_takes_the_raw_sum_without_a_search_and_the_printed_threshold():
    literal = preset("thesis-literal")
    changes = {
        "search": {"rotation_deg": 0.0, "translation_m": 0.0},
        "thesis": {"dense_edges": "every_evaluation", "normalize": False},
        "online": {"similarity_threshold": 0.7, "keyframe_spacing_s": 0.0},
    }
    assert literal == update(preset("thesis"), changes)
    assert load_stages(LITERAL[-1]) == changes


def test_the_file_reads_as_a_table_of_contents():
    """Every step of chapter 3 is named, and every value of the objective that the thesis prints or leaves open."""
    (path,) = THESIS
    text, values = path.read_text(), load_stages(path)
    for step in ("eq. 3.1", "eq. 3.5", "eq. 3.8", "algorithm 1", "algorithm 2", "algorithms 3 to 5", "figure 3.10", "eq. 3.11"):
        assert step in text
    for step in ("eq. 3.12", "eq. 3.14", "3.5", "eq. 3.15", "algorithm 6", "eq. 3.16"):
        assert step in text
    assert {f.name for f in dataclasses.fields(ThesisConfig)} == set(values["thesis"])


def test_options_hold_before_a_file_and_a_file_before_the_preset(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("thesis: {operator: canny}\nsearch: {seed: 3}\n")
    config = configuration(str(path), seed=4, preset_name="thesis")
    assert config == update(preset("thesis"), {"thesis": {"operator": "canny"}, "search": {"seed": 4}})
    with_edges = {"refine": {"objective": "fast", "optimizer": "auto"}}
    path.write_text("refine: {optimizer: auto}\n")
    assert configuration(str(path), objective="fast", preset_name="thesis") == update(preset("thesis"), with_edges)
    assert configuration(None) == Config()


@pytest.mark.parametrize("command", ["calibrate", "replay", "evaluate", "steps", "demo"])
def test_every_command_that_estimates_takes_a_preset(command, capsys):
    source = [] if command == "demo" else ["drive"]
    assert parser(commands()).parse_args([command, *source, "--preset", "thesis-literal"]).preset == "thesis-literal"
    with pytest.raises(SystemExit) as ended:
        parser(commands()).parse_args([command, *source, "--preset", "thesys"])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "'thesys'" in line
    assert "thesis, thesis-literal" in line.replace("'", "")


@pytest.mark.parametrize(("options", "start"), [([], "nominal"), (["--preset", "thesis"], "centroids")])
def test_the_preset_begins_at_its_first_guess_unless_told_another(options, start):
    args = parser().parse_args(["calibrate", "drive", *options])
    assert initial_of(args, preset(args.preset)) == start
    args = parser().parse_args(["calibrate", "drive", "--initial", "reference", *options])
    assert initial_of(args, preset(args.preset)) == "reference"
