"""Every intermediate picture of the method for one frame, in the order of the thesis, as a page that needs no network."""

from __future__ import annotations

import argparse
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import yaml

from calib_ros import __version__
from calib_ros.cli.inputs import configuration, initial_extrinsic, open_named_source
from calib_ros.cli.output import pose, progress_bar
from calib_ros.config import Config
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.io import write_atomically
from calib_ros_check.page import page_template
from calib_ros_evaluation.steps.cloud import Cloud, cloud_steps
from calib_ros_evaluation.steps.image import edge_steps, preparation_steps
from calib_ros_evaluation.steps.maps import map_steps, score_steps
from calib_ros_evaluation.steps.pictures import Matrix, RegisteredFrame, Step
from calib_ros_evaluation.steps.semantics import guess_steps, semantic_steps
from calib_ros_semantics.models.segmentation import SegmentationModels

PAGE = "index.html"
MARK = '<meta name="generator" content="calib-ros steps">'
PICTURE = re.compile(r'<img src="(\d+_[a-z0-9_]+\.png)"')
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

# The parts of the page that differ from the report.
TEMPLATE = """\
{% block contents %}
{% for number, heading, introduction, figures in chapters %}
<div><a href="#section-{{ loop.index }}">{{ number }} {{ heading }}</a>
<ol>
{% for figure in figures %}
<li><a href="#step-{{ figure.number }}">{{ figure.number }} {{ figure.step.name }}</a></li>
{% endfor %}
</ol></div>
{% endfor %}
{% endblock %}
{% block main %}
{% for number, heading, introduction, figures in chapters %}
<section>
<h2 id="section-{{ loop.index }}"><span>{{ number }}</span>{{ heading }}</h2>
<p class="intro">{{ introduction }}</p>
<div class="grid">
{% for figure in figures %}
<figure id="step-{{ figure.number }}"{% if figure.step.wide %} class="wide"{% endif %}>
{% if figure.file %}
<a href="{{ figure.file }}"><img src="{{ figure.file }}" width="{{ figure.size[0] }}" height="{{ figure.size[1] }}" loading="lazy"
 alt="{{ figure.step.name }}"></a>
{% endif %}
{% if figure.step.table %}
<div class="scroll"><table>
<tr>{% for cell in figure.step.table[0] %}<th>{{ cell }}</th>{% endfor %}</tr>
{% for row in figure.step.table[1:] %}
<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</table></div>
{% endif %}
<figcaption><b><span>{{ figure.number }}</span>{{ figure.step.name }}</b>{{ figure.step.caption }}</figcaption>
</figure>
{% endfor %}
</div>
</section>
{% endfor %}
{% endblock %}
"""


def make_steps(frame: Frame, T: Matrix, config: Config, samples: int = SAMPLES) -> Iterator[Step]:
    """The steps of a frame at T_camera_lidar (4, 4), made one by one. samples: of each loss curve.

    The models of the configuration are asked first; one that fails is a step that says so.
    Raises TooFewFeaturesError if the scan is empty, MissingDependencyError without matplotlib.
    """
    models = SegmentationModels(config.semantics)
    scene = RegisteredFrame(frame, T, config, models(frame) if models.active else None)
    yield from preparation_steps(scene)
    yield from edge_steps(scene)
    yield from cloud_steps(scene, Cloud(scene))
    yield from map_steps(scene)
    yield from score_steps(scene, samples)
    yield from semantic_steps(scene)
    yield from guess_steps(scene)


def check_folder(folder: Path) -> None:
    """BadInputError if pictures and page cannot be written there, or if an index.html there is not of this command."""
    standing = next((p for p in (folder, *folder.parents) if p.exists()), folder)
    if not standing.is_dir():
        raise BadInputError(f"--out {folder}: {standing} is a file; choose a folder")
    if not os.access(standing, os.W_OK | os.X_OK):
        raise BadInputError(f"--out {folder}: {standing} cannot be written; check its permissions or choose another folder")
    page, is_ours = folder / PAGE, False
    with suppress(OSError):
        is_ours = MARK in page.read_text(encoding="utf-8", errors="replace")[:2000]
    if page.exists() and not is_ours:
        raise BadInputError(f"--out {folder} holds an {PAGE} that `calib-ros steps` did not write; choose another folder")


def write_page(
    folder: Path,
    title: str,
    facts: Mapping[str, str],
    configuration: str,
    steps: Iterable[Step],
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Write pictures and page once all steps are made; returns the page.

    facts: the page's head. configuration: as YAML. progress: called with the number of steps made. Pictures of an earlier page in
    the folder go. Raises what making the steps raises, then nothing is written; BadInputError if the folder cannot be used;
    MissingDependencyError without Jinja2.
    """
    template = page_template(TEMPLATE)
    check_folder(folder)
    figures, pictures = list[dict[str, Any]](), {}
    for number, step in enumerate(steps, start=1):
        file, size = "", (0, 0)
        if step.picture is not None:
            file = f"{number:02d}_{re.sub('[^a-z0-9]+', '_', step.name.lower()).strip('_')}.png"
            size = (step.picture.shape[1], step.picture.shape[0])
            pictures[file] = cv2.imencode(".png", step.picture)[1].tobytes()
        figures.append({"number": number, "step": step, "file": file, "size": size})
        progress(number)
    chapters = [(key, *heading, [own for own in figures if own["step"].section == key]) for key, heading in SECTIONS.items()]
    page = template.render(title=title, facts=facts, configuration=configuration, chapters=chapters, command="steps")
    target = folder / PAGE
    before = PICTURE.findall(target.read_text(encoding="utf-8", errors="replace")) if target.exists() else []
    for file, data in pictures.items():
        write_atomically(folder / file, data)
    write_atomically(target, page.encode())
    for file in before:
        if file not in pictures:
            (folder / file).unlink(missing_ok=True)
    return target


def run_steps(args: argparse.Namespace) -> str:
    """Write a page with every step of the method for one frame; lines for the user. args: of `calib-ros steps`.

    The extrinsic is the reference where there is one, else nominal, unless --initial says otherwise.
    """
    config = configuration(args.config, preset_name=args.preset)
    source, position = open_named_source(args), args.frame
    if not 0 <= position < len(source):
        raise BadInputError(f"--frame {position}: position is outside 0..{len(source) - 1} of this source")
    folder = Path(args.out)
    check_folder(folder)
    frame = source[position]
    reference = source.reference if frame.reference is None else frame.reference
    initial = args.initial or ("nominal" if reference is None else "reference")
    T = reference if initial == "reference" and reference is not None else initial_extrinsic(initial, source, args.yaw_deg)
    known = source.describe()
    # The command without the output folder and defaults: the same input gives the same page.
    command = ["calib-ros", "steps", args.source, "--frame", str(position)]
    command += ["--camera", args.camera] if args.camera is not None else []
    for option in ("initial", "config", "image_topic", "points_topic", "camera_info_topic", "clock"):
        value = getattr(args, option)
        command += [f"--{option.replace('_', '-')}", value] if value else []
    command += ["--incomplete"] if args.incomplete else []
    command += [] if args.rectified is None else ["--rectified" if args.rectified else "--no-rectified"]
    facts = {
        "Source": known.get("source", f"{source.name}, {known.get('kind', '')}"),
        "Frame": f"{position} of 0..{len(source) - 1}, {frame.name}, {len(frame.cloud)} points",
        "Extrinsic": f"{initial}: {pose(T)}",
        "Command": shlex.join(command + (["--yaw-deg", f"{args.yaw_deg:g}"] if args.yaw_deg else [])),
        "Version": f"calib-ros {__version__}",
    }
    settings = yaml.safe_dump(config.to_dict(), sort_keys=False)
    title = f"The method step by step: {source.name}, frame {position}"
    with progress_bar("drawing") as step:
        made = make_steps(frame, T, config)
        page = write_page(folder, title, facts, settings, made, lambda done: step(min(done, EXPECTED), EXPECTED))
    return f"{page}\nopen it in a browser: {page.resolve().as_uri()}"
