"""What of the results belongs together, in the order in which it is shown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from calib_ros.evaluation.curves import Curves
from calib_ros.evaluation.results import Results, Trial

OURS = "ours"  # name of this project's method


def in_order(results: Results, found: Iterable[str]) -> list[str]:
    """Names of methods in the order of the titles; those without a title come last."""
    known = dict.fromkeys(found)
    return [*(name for name in results.titles if name in known), *(name for name in known if name not in results.titles)]


def all_methods(results: Results) -> list[str]:
    """Every method that has a title or a result."""
    parts = (results.trials, results.curves, results.heat_maps, results.costs, results.averagings)
    return in_order(results, [*results.titles, *(item.method for part in parts for item in part)])


def trials_of(results: Results, experiment: str) -> dict[str, list[Trial]]:
    """Method -> its trials of an experiment; methods without any are left out."""
    found: dict[str, list[Trial]] = {}
    for trial in results.trials:
        if trial.experiment == experiment:
            found.setdefault(trial.method, []).append(trial)
    return {name: found[name] for name in in_order(results, found)}


def accepted(trials: Sequence[Trial]) -> list[Trial]:
    """Those whose end the method itself trusts."""
    return [t for t in trials if t.status == "done"]


def start_sizes(trials: Iterable[Trial]) -> list[tuple[float, float]]:
    """The sizes of start errors, deg and m, ascending."""
    return sorted({(t.start_deg, t.start_m) for t in trials})


def curves_of_scenes(results: Results) -> dict[str, dict[str, Curves]]:
    """Label of a scene -> method -> curves."""
    found: dict[str, dict[str, Curves]] = {}
    for result in results.curves:
        found.setdefault(result.label, {})[result.method] = result.curves
    return {label: {name: own[name] for name in in_order(results, own)} for label, own in found.items()}


def curves_of_methods(results: Results) -> dict[str, list[Curves]]:
    """Method -> curves of all its scenes."""
    scenes = curves_of_scenes(results)
    names = in_order(results, (name for own in scenes.values() for name in own))
    return {name: [own[name] for own in scenes.values() if name in own] for name in names}
