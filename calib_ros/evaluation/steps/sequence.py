"""Every intermediate picture of the method for one frame, in the order of the thesis (`calib-ros steps`)."""

from __future__ import annotations

from collections.abc import Iterator

from calib_ros.config import Config
from calib_ros.evaluation.steps.cloud import Cloud, cloud_steps
from calib_ros.evaluation.steps.first_guess import guess_steps
from calib_ros.evaluation.steps.image import edge_steps, preparation_steps
from calib_ros.evaluation.steps.maps import map_steps
from calib_ros.evaluation.steps.objects import object_steps
from calib_ros.evaluation.steps.score import score_steps
from calib_ros.evaluation.steps.semantics import semantic_steps
from calib_ros.evaluation.steps.step import Matrix, Scene, Step
from calib_ros.frame import Frame
from calib_ros.semantics.segmentation import Segmentation

# Number -> heading and what happens there.
SECTIONS = {
    "3.2": ("Image processing", "The image turns grey, gets an even contrast and loses its noise, so that edges show."),
    "3.4.2": ("Image edges", "Edge operators (3.4.1) turn the image into the edge map E^I, which is smoothed (3.4.2)."),
    "3.3": ("Point cloud pre-processing", "The scan by itself, without any extrinsic: filters, ground, objects."),
    "3.4.3": ("Point cloud edges", "The scan is projected into the picture, made dense, and edges are taken from it: E^L."),
    "3.4.4": ("Registration", "Where edges of both sensors meet, the score of eq. 3.12 adds up; the best extrinsic has most."),
    "3.5": ("Semantics", "Masks and classes: clearer edges (3.4.2), a first guess (3.5), weights of frames (3.6)."),
}
EXPECTED = 70  # steps of a colour image and a scan with reflectivity, with the builtin classes; for progress only
SAMPLES = 41  # of a loss curve


def steps(frame: Frame, T: Matrix, config: Config, samples: int = SAMPLES) -> Iterator[Step]:
    """The steps of a frame at T_camera_lidar (4, 4), made one by one. samples: of each loss curve.

    The models of the configuration are asked first; one that fails is a step that says so.
    Raises TooFewFeaturesError if the scan is empty, MissingDependencyError without scikit-learn or matplotlib.
    """
    models = Segmentation(config.semantics)
    scene = Scene.of(frame, T, config, models(frame) if models.wanted else None)
    yield from preparation_steps(scene)
    yield from edge_steps(scene)
    cloud = Cloud.of(scene)
    yield from cloud_steps(scene, cloud)
    yield from object_steps(scene, cloud)
    yield from map_steps(scene)
    yield from score_steps(scene, samples)
    yield from semantic_steps(scene)
    yield from guess_steps(scene)
