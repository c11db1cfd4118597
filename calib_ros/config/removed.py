"""Options that there were in former versions: files and parameters that name them are still read, without effect."""

from __future__ import annotations

from collections.abc import Iterable

_FIELDS = {  # by stage
    "image": (
        "equalize_color clahe_clip clahe_tiles gaussian_sigma bilateral_diameter bilateral_color bilateral_space "
        "gradient_percentile equalization filter"
    ),
    "lidar": (
        "jump_min side_jump_ratio top_jump_ratio jump_saturation reflectivity_step reflectivity_max_range reflectivity_max_jump "
        "outward_shift top_spread gap_steps hole_jump max_range"
    ),
    "motion": "check_times max_gap_s voxel_m max_speed max_turn_rate min_matched exposure_s",
    "score": (
        "oriented weight_side weight_top weight_sky_side weight_sky_top ring_spacing_deg weight_floor sigma local_contrast "
        "margin min_points"
    ),
    "capture": "keep max_mb",
    "camera": "centre_sigma",
    "thesis": (
        "smoothing semantic_share min_depth max_depth min_height max_height min_reflectivity max_reflectivity azimuth_deg "
        "azimuth_half_width_deg low_reflectivity evaluations class_edge_share "
        "ground_tilt_deg ground_share cluster_voxel depth_step reflectivity_step max_discontinuity "
        "first_step_deg ground_distance ground_iterations cluster_eps cluster_min_points cluster_max_depth closing "
        "canny_low canny_high completion"
    ),
    "refine": "check_intrinsics iterations max_rotation_deg max_translation_m min_peak_ratio min_distinctness",
    "monitor": "false_alarm_rate window blind_contrast blind_returns confirm least_deg least_m frozen_images",
    "semantics": (
        "first_guess prompt_batch edge_share class_edge_share match_classes consistency_check weight_vehicle weight_person "
        "weight_pole weight_building weight_vegetation weight_ground weight_other min_iou min_stability nms_iou witness"
    ),
    "guess": "candidates tilt_deg distance_m",
    "search": "agreement distinct climbed refined finalists first_points coarse_points middle_points simplex_evaluations",
    "online": "search_rounds keyframe_interval_s static_similarity rest_spacing_s pair_queue max_speed",
    "tracker": "max_step_deg max_step_m gate drift_deg drift_m process_noise_deg process_noise_m",
}
REMOVED = frozenset(f"{stage}.{name}" for stage, names in _FIELDS.items() for name in names.split())
FORMER_STAGES = frozenset(_FIELDS)
_ELSEWHERE = "--initial FILE or initial_quaternion_xyzw, for a camera that is mounted so"
INSTEAD = {
    "semantics.first_guess": "initial.method: semantic",
    "motion.exposure_s": "motion.time_offset_s: minus half of it",
    "camera.centre_sigma": "camera.focal_sigma, of which it is 0.4",
    "guess.tilt_deg": _ELSEWHERE,
    "guess.distance_m": _ELSEWHERE,
    "thesis.completion": "morphology, eq. 3.11",
}


def notices(names: Iterable[str]) -> list[str]:
    """A line that names all options (``stage.field``) that have been removed; none where there are none."""
    gone = [name for name in names if name in REMOVED]
    has, it = ("has", "it") if len(gone) == 1 else ("have", "them")
    others = "".join(f"; in place of {name} there is {INSTEAD[name]}" for name in gone if name in INSTEAD)
    return [f"{', '.join(gone)} {has} no effect any more; remove {it}{others}"] if gone else []
