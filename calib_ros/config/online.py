"""The constants of what happens over time."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option

MANUAL, PERIODIC, CONTINUOUS = "manual", "periodic", "continuous"  # modes


@dataclass(frozen=True)
class OnlineConfig(Stage):
    """What happens over time: pairing, keyframes, estimates."""

    pair_tolerance_s: float = option(
        0.05, "image and cloud stamps farther apart than this are not paired, s", low=0.0001, high=1.0
    )
    pair_queue: int = option(8, "images and clouds kept while they wait for a partner", low=1, high=100)
    similarity_threshold: float = option(
        0.92,
        "an image less similar than this to the last keyframe's is a keyframe "
        "(the thesis's 0.7 keeps 3 of 154 frames of a drive)",
        low=0.0,
        high=1.0,
    )
    keyframe_interval_s: float = option(
        1.0, "after this time without a keyframe one is taken if the picture changed at all, s", low=0.05, high=3600.0
    )
    keyframe_spacing_s: float = option(
        0.25,
        "keyframes are at least this far apart, s: what is seen twice says nothing new (spread frames halve the error)",
        low=0.0,
        high=60.0,
    )
    static_similarity: float = option(
        0.995, "images more similar than this show the same scene and are never a new keyframe", low=0.5, high=1.0
    )
    buffer_size: int = option(20, "keyframes in the ring buffer", low=1, high=200)
    min_keyframes: int = option(5, "keyframes before the first estimate", low=1, high=200)
    search_rounds: int = option(
        2, "rounds of a search at new keyframes; one that the service asks for takes up to search.rounds", low=1, high=1000
    )
    mode: str = option(
        "continuous",
        "when to estimate: continuous = at new keyframes; periodic = every period_s if there are new keyframes; "
        "manual = only when the service asks",
        choices=("manual", "periodic", "continuous"),
    )
    period_s: float = option(60.0, "time between the estimates of mode periodic, by the data's stamps, s", low=0.1, high=86400.0)
    max_load: float = option(
        1.0,
        "share of one core's time that estimates may take: after one of t seconds the next waits until t / max_load after its "
        "start; the service never waits",
        low=0.05,
        high=1.0,
    )
    max_speed: float = option(40.0, "no keyframe is taken at a higher speed of the vehicle, m/s", low=0.1, high=200.0)
    max_turn_deg_s: float = option(30.0, "no keyframe is taken while the vehicle turns faster, deg/s", low=0.1, high=1000.0)
