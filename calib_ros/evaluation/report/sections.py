"""The report's sections, in the order of the thesis."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from calib_ros.evaluation.report import sections_scores, sections_trials, trust
from calib_ros.evaluation.report.pictures import Picture
from calib_ros.evaluation.report.plots import styles
from calib_ros.evaluation.report.section import Section
from calib_ros.evaluation.report.selection import all_methods
from calib_ros.evaluation.results import Results

CASES = (
    "Where LiDAR points and edges fall in the image under the reference and where a trial ended: the best and the worst that "
    "this project's method accepted, and the worst of each rival. As the thesis's figures 4.6, 4.9 and 4.12, but not only the "
    "good ones."
)


def sections(results: Results, pictures: Sequence[Picture]) -> list[Section]:
    """Those that have anything to show; of others it is said why they have not, where that is known."""
    looks = styles(all_methods(results))
    made = [
        sections_trials.overview(results, looks),
        sections_scores.loss_curves(results, looks),
        sections_scores.heat_maps(results),
        sections_trials.single(results, looks),
        sections_trials.traces(results, looks),
        sections_trials.starts(results, looks),
        sections_trials.frames(results, looks),
        sections_scores.averaging(results),
        sections_scores.drive(results),
        trust.section(results),
        sections_scores.cost(results, looks),
        Section("cases", "Best and worst cases", CASES, pictures=tuple(pictures)),
        sections_trials.troubles(results),
    ]
    told = [_with_reason(section, results) if section.is_empty else section for section in made]
    return [section for section in told if not section.is_empty]


def _with_reason(section: Section, results: Results) -> Section:
    """What failed begins with the name of its experiment, which is the section's key."""
    reasons = list(dict.fromkeys(why for what, why in results.failures if re.split(r"\W", what, maxsplit=1)[0] == section.key))
    more = f" ({len(reasons) - 1} other reasons are listed at the end)" if len(reasons) > 1 else ""
    return replace(section, sentences=(f"There is nothing to show: {reasons[0]}{more}",) if reasons else ())
