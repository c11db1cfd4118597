"""What can be guessed of the extrinsic from classes alone (thesis 3.5, figure 3.21)."""

from __future__ import annotations

from collections.abc import Iterator

from calib_ros import se3
from calib_ros.errors import TooFewFeaturesError
from calib_ros.evaluation.steps.semantics import SECTION, fitted, points_on_image
from calib_ros.evaluation.steps.step import Matrix, Scene, Step
from calib_ros.lidar.deskew import still_frame
from calib_ros.registration.first_guess.guess import first_guess


def guess_steps(scene: Scene) -> Iterator[Step]:
    """The guess from this frame alone and the other hypotheses; nothing where points or pixels have no classes."""
    view = scene.features.fast.view
    if view is None or scene.seen is None or scene.seen.labels is None:
        return
    try:
        guesses = first_guess([view], scene.config.guess, scene.config.search.seed)
    except TooFewFeaturesError as error:
        yield Step(SECTION, "First guess", f"Figure 3.21 is missing, for nothing can be guessed from this frame: {error}.")
        return
    frame = still_frame(scene.source, scene.config.motion)
    yield Step(
        SECTION,
        "First guess",
        "Figure 3.21: classes of points at the best guess from this frame alone, which knows of no extrinsic. "
        f"It is {_off(scene, guesses[0].T)} away from the extrinsic of this page. It is only where the registration "
        "starts; a vehicle guesses from several keyframes.",
        fitted(points_on_image(frame, frame.cloud.xyz, scene.seen.labels, guesses[0].T), scene),
    )
    rows: list[tuple[str, ...]] = [("hypothesis", "score", "margin", "from", "objects met", "away from this page's extrinsic")]
    for k, h in enumerate(guesses, start=1):
        rows.append((str(k), f"{h.score:.3f}", f"{h.margin:.3f}", h.kind, str(h.inliers), _off(scene, h.T)))
    yield Step(
        SECTION,
        "Hypotheses",
        "What the classes would allow, best first, from centroids of objects (3.5) or from a sweep over all directions. Score: "
        "mean log likelihood ratio of the points in view times the root of their share, 0 by chance. Those that score nearly as "
        "much as the best are all registered, and their edges decide.",
        table=tuple(rows),
        wide=True,
    )


def _off(scene: Scene, T: Matrix) -> str:
    return f"{se3.rotation_error_deg(scene.T, T):.1f} deg, {100 * se3.translation_error_m(scene.T, T):.0f} cm"
