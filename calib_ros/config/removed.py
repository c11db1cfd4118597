"""Options that there were in former versions: what names them is still read, and what they were set to has no effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# stage.field -> the value that it has for good; None = what it was for has gone.
REMOVED: dict[str, Any] = {
    "image.equalize_color": False,
    "image.clahe_clip": 2.0,
    "image.clahe_tiles": 8,
    "image.gaussian_sigma": 1.0,
    "image.bilateral_diameter": 5,
    "image.bilateral_color": 40.0,
    "image.bilateral_space": 5.0,
    "image.gradient_percentile": 97.0,
    "lidar.jump_min": 0.3,
    "lidar.side_jump_ratio": 0.02,
    "lidar.top_jump_ratio": 0.05,
    "lidar.jump_saturation": 3.0,
    "lidar.reflectivity_step": 0.12,
    "lidar.reflectivity_max_range": 40.0,
    "lidar.reflectivity_max_jump": 0.2,
    "lidar.outward_shift": 0.5,
    "lidar.top_spread": 1.0,
    "lidar.gap_steps": 6,
    "lidar.hole_jump": 0.5,
    "motion.check_times": True,
    "motion.max_gap_s": 0.35,
    "motion.voxel_m": 0.8,
    "motion.max_speed": 60.0,
    "motion.max_turn_rate": 2.0,
    "motion.min_matched": 0.65,
    "score.oriented": True,
    "score.weight_side": 1.0,
    "score.weight_top": 0.6,
    "score.weight_sky_side": 0.5,
    "score.weight_sky_top": 0.3,
    "score.ring_spacing_deg": 0.4,
    "score.weight_floor": 150,
    "score.sigma": (16.0, 8.0, 4.0, 2.0, 1.2),
    "score.local_contrast": True,
    "score.margin": 0.28,
    "score.min_points": 200,
    "thesis.class_edge_share": 0.1,
    "thesis.ground_tilt_deg": 15.0,
    "thesis.ground_share": 0.05,
    "thesis.cluster_voxel": 0.15,
    "thesis.depth_step": 3.0,
    "thesis.reflectivity_step": 0.2,
    "thesis.max_discontinuity": 3.0,
    "thesis.first_step_deg": 1.6,
    "refine.check_intrinsics": True,
    "monitor.false_alarm_rate": None,
    "semantics.first_guess": False,
    "semantics.prompt_batch": 16,
    "semantics.edge_share": 0.5,
    "semantics.class_edge_share": 0.0,
    "semantics.match_classes": False,
    "semantics.consistency_check": True,
    "semantics.weight_vehicle": 1.0,
    "semantics.weight_person": 1.0,
    "semantics.weight_pole": 1.0,
    "semantics.weight_building": 1.0,
    "semantics.weight_vegetation": 0.5,
    "semantics.weight_ground": 0.5,
    "semantics.weight_other": 1.0,
    "semantics.min_iou": 0.88,
    "semantics.min_stability": 0.95,
    "semantics.nms_iou": 0.7,
    "guess.candidates": 5,
    "search.agreement": 3,
    "search.distinct": 20,
    "search.climbed": 10,
    "search.refined": 2,
    "search.finalists": 2,
    "search.first_points": 1500,
    "search.coarse_points": 5000,
    "search.middle_points": 15000,
    "search.simplex_evaluations": 120,
    "refine.iterations": 20,
    "refine.max_rotation_deg": 3.0,
    "refine.max_translation_m": 0.5,
    "online.search_rounds": 2,
    "online.keyframe_interval_s": 1.0,
    "online.static_similarity": 0.995,
    "online.rest_spacing_s": 2.0,
    "tracker.max_step_deg": 1.0,
    "tracker.max_step_m": 0.15,
    "tracker.gate": 1e-4,
    "monitor.window": 5,
    "monitor.blind_contrast": 0.25,
    "monitor.blind_returns": 0.2,
    "semantics.witness": True,
    "refine.min_peak_ratio": None,
    "refine.min_distinctness": None,
}
# What to set in place of those that had another value.
INSTEAD = {"semantics.first_guess": "initial.method: semantic"}


def notices(given: Mapping[str, Any]) -> list[str]:
    """A line for each of the removed options given (``stage.field``: value) that now has another value, one for all others."""
    changed = [name for name, value in given.items() if REMOVED[name] is not None and not _same(value, REMOVED[name])]
    lines = [
        f"{name} has no effect any more, {_text(REMOVED[name])} is used; "
        + (f"set {INSTEAD[name]} in its place" if name in INSTEAD else "remove it")
        for name in changed
    ]
    others = [name for name in given if name not in changed]
    if others:
        has, it = ("has", "it") if len(others) == 1 else ("have", "them")
        lines.append(f"{', '.join(others)} {has} no effect any more; remove {it}")
    return lines


def _same(value: Any, other: Any) -> bool:
    return bool((tuple(value) if isinstance(value, list) else value) == other)


def _text(value: Any) -> str:
    """As YAML writes it."""
    if isinstance(value, tuple):
        return str(list(value))
    return str(value).lower() if isinstance(value, bool) else f"{value:g}"
