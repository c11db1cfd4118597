"""What others report by the protocols: their figures as published, where these stand, and what to know before comparing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from calib_ros_evaluation.evaluate import StudyReport
from calib_ros_evaluation.protocols.definitions import BORER, MISCALIBRATION, SINGLE_FRAME, UNICALIB, Size
from calib_ros_evaluation.report.sections import Section
from calib_ros_evaluation.report.table import Table

OURS = (
    "This project: the frames of each trial are drawn uniformly of all frames of the source, good or bad. Starts are left "
    "perturbations in the camera's frame, the region searched is the size of the start error. A refused trial counts as a "
    "failure; it hands back its start, whose error counts in the mean of all trials. Wrong: accepted, but beyond the limits. "
    "Constants were chosen on KITTI drive 0005, odometry 00 and synthetic drives.",
)
# Title, introduction, and what to know before comparing.
TEXTS = {
    SINGLE_FRAME.name: (
        "One harness for learned and classical systems (ProjFusion)",
        "Starts are drawn as by the published code: an amplitude uniform in 0 to the size, once for the rotation and once for "
        "the shift, then each axis uniform within it. Success: below 2 deg and 5 cm.",
        "Published: tables of ProjFusion, the code of NativeCross (Ou et al., RA-L 2026, arXiv:2603.29414), single "
        "frames; success is its L2. NativeCross was trained on KITTI odometry 00, 02-08, 10, 12, 21 or on nuScenes, for "
        "each size of start error anew, and tested on KITTI odometry 13-16, 18 or other nuScenes scenes: other drives of "
        "the vehicles it knows. How the other learned systems were trained there, the tables do not say. DirectCalib "
        "(Koide) and CalibAnything are classical; DirectCalib is made for denser or accumulated scans.",
        "The published errors are those of T T_ref^-1, ours those of eq. 2.19: the translations differ by up to the rotation "
        "error times the distance of the sensors, 5 mm for 1 deg on KITTI.",
    ),
    MISCALIBRATION: (
        "Miscalibration detection on KITTI odometry 00",
        "Published perturbations, rotations doubled as by the published code. Right is a pass of the set pos and a fail of any "
        "other set, by the check with a tolerance of 1 deg and 5 cm.",
        "Published: the learned detector of TUM (MiscalibrationDetection) and two rivals as it reports them, of many more frames "
        "of the same sequence; it was trained on KITTI. It tells right from wrong without a tolerance, and always decides.",
    ),
    BORER.name: (
        "Geometric mutual information (Borer et al.)",
        "Each axis of a start is uniform within the size. Success: below 0.5 deg and 20 cm.",
        "Published: Borer et al., From Chaos to Calibration (arXiv:2311.01905), classical, 25 frames per trial. How the "
        "directions of its starts are drawn is not known to us.",
    ),
    UNICALIB.name: (
        "Mean errors (UniCalib)",
        "Each axis of a start is uniform within the size. The publication reports mean errors and no limits of success; success "
        "below 2 deg and 5 cm is shown for our trials only.",
        "Published: UniCalib (WACV 2026), learned, trained per rig, on a GPU. How many frames a figure rests on, and how its "
        "starts are drawn, is not known to us.",
    ),
}

_SIZES = (Size(15, 0.15), Size(10, 0.25), Size(10, 0.5))
# System, data; then success in %, mean rotation error in deg and mean translation error in cm for each of _SIZES.
_HARNESS = (
    ("DirectCalib (classical)", "KITTI", (1.5, 13.1, 195), (1.8, 13.1, 147), (0.8, 12.7, 223)),
    ("CalibAnything (classical)", "KITTI", (1.9, 18.3, 27.3), (12.4, 5.32, 28.2), (8.6, 6.02, 49.9)),
    ("LCCNet (learned)", "KITTI", (31.7, 2.10, 6.12), (27.8, 2.50, 6.08), (25.6, 2.55, 6.72)),
    ("LCCRAFT (learned)", "KITTI", (44.1, 0.53, 6.03), (42.4, 0.59, 6.27), (39.1, 0.95, 6.48)),
    ("CalibDepth (learned)", "KITTI", (56.9, 1.06, 4.57), (39.2, 1.99, 5.44), (41.8, 1.77, 5.28)),
    ("NativeCross (learned)", "KITTI", (96.6, 0.43, 2.20), (92.6, 0.65, 2.59), (87.7, 0.76, 2.75)),
    ("DirectCalib (classical)", "nuScenes", (0.2, 14.9, 452), (0.2, 13.3, 268), (0.3, 12.7, 359)),
    ("CalibAnything (classical)", "nuScenes", (3.3, 7.51, 7.24), (5.7, 4.73, 11.9), (3.5, 4.73, 23.9)),
    ("LCCNet (learned)", "nuScenes", (41.9, 2.34, 5.59), (41.5, 2.41, 5.86), (29.4, 2.83, 7.56)),
    ("LCCRAFT (learned)", "nuScenes", (57.5, 0.71, 5.57), (55.0, 0.64, 5.63), (40.1, 0.94, 7.41)),
    ("CalibDepth (learned)", "nuScenes", (79.1, 0.30, 3.33), (74.1, 0.39, 3.78), (54.4, 0.36, 5.71)),
    ("NativeCross (learned)", "nuScenes", (99.9, 0.37, 0.51), (99.7, 0.39, 0.53), (99.2, 0.60, 0.77)),
)
BY_BORER, BY_UNICALIB = "Borer et al. (classical)", "UniCalib (learned)"
# A row for each published one. frames: per trial, 0 = not known. NaN = not published.
PUBLISHED = pd.DataFrame(
    [
        *(
            (SINGLE_FRAME.name, *size, system, data, 1, *figures)
            for system, data, *of_sizes in _HARNESS
            for size, figures in zip(_SIZES, of_sizes, strict=True)
        ),
        (BORER.name, 10, 0, BY_BORER, "KITTI", 25, 96.5, math.nan, math.nan),
        (BORER.name, 10, 0, BY_BORER, "KITTI-360", 25, 100.0, math.nan, math.nan),
        (BORER.name, 0.5, 0.5, BY_BORER, "KITTI", 25, 88.0, math.nan, math.nan),
        (BORER.name, 0.5, 0.5, BY_BORER, "KITTI-360", 25, 76.5, math.nan, math.nan),
        (UNICALIB.name, 5, 0.1, BY_UNICALIB, "KITTI odometry", 0, math.nan, 0.044, 0.55),
        (UNICALIB.name, 10, 0.25, BY_UNICALIB, "KITTI raw", 0, math.nan, 0.084, 2.37),
    ],
    columns=["protocol", "start_deg", "start_m", "system", "data", "frames", "success_percent", "deg", "cm"],
)
# Shares of right decisions in %, over all sets, of rot_hard and of trans_easy.
ACCURACIES = {"TUM detector": (99.1, 99.0, 99.97), "rival 1": (95.1, 86.3, 92.1), "rival 2": (90.9, 86.5, 90.4)}


def protocol_report(name: str, tables: Sequence[Table], notes: Sequence[str], file: str, rows: pd.DataFrame) -> StudyReport:
    """The report of a protocol: one section, whose caveats and notes stand below its last table."""
    title, introduction, *caveats = TEXTS[name]
    tables = [*tables[:-1], replace(tables[-1], notes=(*caveats, *notes))]
    said = [line for one in tables for line in (one.title, one.text(), "")]
    return StudyReport(f"Published protocol: {title}", [Section(name, title, introduction, tables=tables)], said, file, rows)
