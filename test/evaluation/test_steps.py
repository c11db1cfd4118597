"""`calib-ros steps`: every picture of the method for one frame, and the page that shows them."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from html_pages import Page
from thesis_constants import with_constants

from calib_ros import Config, Frame, PointCloud, se3
from calib_ros.cli import main
from calib_ros.frame import MAIN_CLASSES, SemanticClass
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import Result
from calib_ros_evaluation.steps.cloud import Cloud
from calib_ros_evaluation.steps.page import EXPECTED, SECTIONS, check_folder, make_steps, write_page
from calib_ros_evaluation.steps.pictures import VIRIDIS, RegisteredFrame, Scale, Step, busiest, class_histogram, enlarged
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_synthetic.rig import RigPair

pytestmark = pytest.mark.usefixtures("rendered_once")
SOURCE = "synthetic:seed=1,frames=2,rings=32,width=480,height=144"
NONE = Config.from_dict({"semantics": {"segmentation": "none"}})
FEW = 5  # samples of a loss curve, where it is not looked at


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main.main(["steps", *arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of the synthetic drive."""
    out = tmp_path_factory.mktemp("steps") / "out"
    assert main.main(["steps", SOURCE, "--frame", "1", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive(seed=1, frames=2, rings=32, width=480, height=144)


def test_the_page_shows_exactly_the_pictures_that_exist(made: Path) -> None:
    html = (made / "index.html").read_text()
    page = Page(html)
    assert sorted(page.sources) == sorted(path.name for path in made.glob("*.png"))
    assert len(page.sources) == len(set(page.sources)) == html.count('loading="lazy"') > 45
    assert {path.suffix for path in made.iterdir()} == {".png", ".html"}
    assert len(page.captions) >= len(page.sources)
    assert all(len(caption) > 60 for caption in page.captions)
    assert not any(":" in link for link in page.links + page.sources)  # neither network nor this machine's folders
    for link in page.links:
        assert link.removeprefix("#") in page.ids if link.startswith("#") else (made / link).is_file(), link
    assert len(page.captions) <= EXPECTED <= len(page.captions) + 3
    text = (made / "index.html").read_text()
    for number, (heading, _) in SECTIONS.items():
        assert f"<span>{number}</span>{heading}" in text
    for fact in ("calib-ros steps", "--frame 1", "reference: x ", "1 of 0..1", "normalize: true", "prefers-color-scheme"):
        assert fact in text


def test_every_picture_shows_something(made: Path) -> None:
    seen: dict[bytes, str] = {}
    for path in sorted(made.glob("*.png")):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert picture is not None, path.name
        assert picture.std() > 3, f"{path.name} is all but empty"
        first = seen.setdefault(picture.tobytes(), path.name)
        assert first == path.name or "prepared" in path.name, f"{path.name} is the same as {first}"


def test_twice_gives_the_same_bytes(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = tmp_path / "deep" / "again"
    code, out, _ = run(capsys, SOURCE, "--frame", "1", "--out", str(again))
    assert (code, content(again)) == (0, content(made))
    assert out.splitlines()[0] == str(again / "index.html")
    assert "browser" in out


def test_captions_hold_the_numbers_of_the_frame(drive: SyntheticDrive) -> None:
    frame, T = drive[1], drive.reference
    found = {step.name: step for step in make_steps(frame, T, Config(), FEW)}
    assert f"{len(frame.cloud)} returns" in found["Scan by depth"].caption
    on_image = re.search(r"(\d+) pixels \(", found["Scan on the image"].caption)
    uv, inside = frame.camera.project(se3.transform(T, frame.cloud.xyz))
    pixels = len(np.unique(np.rint(uv[inside]), axis=0))
    assert on_image
    assert 0.97 * pixels <= int(on_image[1]) <= 1.01 * pixels
    rows = {row[0]: row[1:] for row in found["Scores"].table}
    assert set(rows) == {"score", "J, eq. 3.12", "J / LiDAR edges", "fast score"}
    for name in ("J, eq. 3.12", "J / LiDAR edges", "fast score"):
        here, moved, _ = rows[name]
        assert float(here) > float(moved), name
    assert f"J = {float(rows['J, eq. 3.12'][0]):.1f}"[:6] in found["Overlay"].caption
    peaks = {row[0]: row[1:] for row in found["Peaks"].table}
    assert len(peaks["fast score"]) == 6


def test_a_source_without_colour_and_intensity(drive: SyntheticDrive, tmp_path: Path) -> None:
    frame = drive[0]
    gray = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
    plain = dataclasses.replace(frame, image=gray, cloud=PointCloud(frame.cloud.xyz, ring=frame.cloud.ring))
    made = list(make_steps(plain, drive.reference, Config(), FEW))
    names = [step.name for step in made]
    assert not {"CLAHE on colour", "Filter by reflectivity", "Sparse reflectivity", "Edges of reflectivity"} & set(names)
    missing = made[names.index("Scan by reflectivity")]
    assert missing.picture is None
    assert "no intensity" in missing.caption
    assert made[0].picture is not None
    assert made[0].picture.ndim == 2
    page = write_page(tmp_path, "plain", {}, "", made)
    assert len(Page(page.read_text()).captions) == len(made)


def test_the_filters_shown_are_those_of_the_method_without_intensity_too(drive: SyntheticDrive) -> None:
    """A threshold on reflectivity says nothing where the source tells none."""
    frame, config = drive[0], with_constants(Config(), min_reflectivity=0.5)
    bare = dataclasses.replace(frame, cloud=PointCloud(frame.cloud.xyz, ring=frame.cloud.ring))
    scene = RegisteredFrame(bare, drive.reference, config)
    cloud = Cloud(scene)
    assert np.count_nonzero(cloud.passed) == len(scene.thesis.points) > 1000
    assert np.count_nonzero(cloud.ground) == np.count_nonzero(scene.thesis.points.ground)
    assert np.array_equal(np.bincount(cloud.label[cloud.passed]), np.bincount(scene.thesis.points.label))


@pytest.mark.filterwarnings("error")
def test_a_covered_lens(drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a single image edge there are still pictures, and no division by nothing."""
    said = "its classes cannot be right"
    monkeypatch.setattr("calib_ros_semantics.models.segmentation.implausible", lambda classes, known: said)
    black = dataclasses.replace(drive[0], image=np.zeros_like(drive[0].image))
    made = {step.name: step for step in make_steps(black, drive.reference, NONE, FEW)}
    assert len(made) == EXPECTED - 9
    assert float(made["Scores"].table[1][1]) < 1  # the equalisation leaves traces of its tiles
    classified = {step.name: step for step in make_steps(black, drive.reference, Config(), FEW)}
    # What a network finds in darkness is no evidence: its step says so, and what would follow from its classes is left out.
    assert said in classified["Problem with a model"].caption
    assert {"Classes of points", "Scores"} < set(classified)
    assert not {"Borders of classes", "Classes of pixels"} & set(classified)


def masks_of(frame: Frame, folder: Path) -> Path:
    """A picture for each class of the frame, as a folder of ready masks."""
    assert frame.classes is not None
    (folder / frame.name).mkdir(parents=True)
    for c in np.unique(frame.classes):
        cv2.imwrite(str(folder / frame.name / f"{c}.png"), np.uint8(255) * (frame.classes == c))
    return folder


def shows_semantics(folder: Path, edges: str) -> bool:
    """Its last pictures are those of semantics, the first of them of such edges."""
    names = [path.name[3:-4] for path in sorted(folder.glob("*.png"))]
    return names[-8:] == [
        *(edges, "blended_edges", "blended_edges_magnified", "classes_of_pixels", "pixels_by_class"),
        *("classes_of_points", "classes_of_points_on_the_image", "first_guess"),
    ]


def test_the_builtin_classes_give_borders_a_guess_and_numbers(made: Path) -> None:
    text = (made / "index.html").read_text()
    assert shows_semantics(made, "borders_of_classes")
    assert "the builtin network sees" in text
    assert re.search("score (uses none|blends 0%) of them", text)
    assert "the rest are borders of classes, see Semantics" in text
    assert "Borders of classes are blended in" in text
    assert "of masks are blended in" not in text
    assert "No model" not in text


def test_page_without_semantics_has_a_note(drive: SyntheticDrive, tmp_path: Path) -> None:
    failing = {"segment_anything": str(tmp_path / "none.onnx"), "image_classes": "", "cloud_classes": ""}
    cases = {"No semantics": (NONE, "No model is configured"), "Problem with a model": ({"semantics": failing}, "none.onnx")}
    for name, (config, said) in cases.items():
        made = list(make_steps(drive[1], drive.reference, config if config is NONE else Config.from_dict(config), FEW))
        found = {step.name: step for step in made}
        assert len(made) == EXPECTED - 9
        assert [step.name for step in made if step.section == "3.5"] == [name]
        assert said in found[name].caption
        assert "No semantic edges are blended in" in found["Smoothing, magnified"].caption
        assert "this is E^I before its smoothing" in found["Mix edges"].caption


def test_all_models_together(drive: SyntheticDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    masks = masks_of(drive[1], tmp_path / "masks")
    own = {"segment_anything": str(masks), "image_classes": "source", "cloud_classes": "source"}
    (tmp_path / "models.yaml").write_text(json.dumps({"semantics": own}))
    out = tmp_path / "out"
    code, _, err = run(capsys, SOURCE, "--frame", "1", "--config", str(tmp_path / "models.yaml"), "--out", str(out))
    assert code == 0, err
    frame = drive[1]
    w = np.isin(frame.classes, [1, 2, 3, 4, 5]).mean()
    text = (out / "index.html").read_text()
    assert f"w_j = {w:.1%}" in text
    assert f"100% of the {len(frame.cloud)} points" in text
    assert "what 50% of E^I before its smoothing" in text
    assert "Boundaries of masks are blended in" in text
    assert "score blends 50% of them into its edges of either direction" in text
    assert "No model" not in text
    counts = {c.name.lower(): int((frame.classes == c).sum()) for c in SemanticClass}
    bars = class_histogram(counts, [c.name.lower() for c in MAIN_CLASSES])
    np.testing.assert_array_equal(cv2.imread(str(next(out.glob("*pixels_by_class.png")))), bars)
    row = re.search(r"<td>vehicle</td><td>([0-9.]+)%</td><td>([0-9.]+)%</td>", text)
    assert row
    assert float(row[1]) == pytest.approx(100 * np.mean(frame.classes == 1), abs=0.06)
    assert float(row[2]) == pytest.approx(100 * np.mean(frame.cloud.label == 1), abs=0.06)
    assert shows_semantics(out, "boundaries_of_masks")
    pictures = [path.read_bytes() for path in out.glob("*.png")]
    assert len(set(pictures)) >= len(pictures) - 1  # one edge operator is that of the run
    assert "Figure 3.21" in text


def test_a_frame_that_allows_no_guess(drive: SyntheticDrive) -> None:
    """One class only: the page says why there is none."""
    frame = drive[0]
    assert frame.classes is not None
    ground = dataclasses.replace(
        frame,
        classes=np.full_like(frame.classes, 8),
        cloud=dataclasses.replace(frame.cloud, label=np.full(len(frame.cloud), 8, np.uint8)),
    )
    config = Config.from_dict({"semantics": {"image_classes": "source", "cloud_classes": "source"}})
    made = {step.name: step for step in make_steps(ground, drive.reference, config, FEW)}
    assert made["First guess"].picture is None
    assert "2 classes" in made["First guess"].caption
    assert "Hypotheses" not in made


def test_extrinsic_with_no_points_in_view(drive: SyntheticDrive) -> None:
    """The camera looks into the sky: maps are empty, the page says so instead of failing."""
    up = se3.exp([np.deg2rad(-88.0), 0, 0, 0, 0, 0]) @ nominal()
    made = {step.name: step for step in make_steps(drive[0], up, Config(), FEW)}
    assert "No curves" in made["Loss curves"].caption
    assert made["Dense depth"].picture is not None


def test_an_empty_scan_is_one_line_and_no_page(
    drive: SyntheticDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = RigPair.__getitem__

    def empty(self: RigPair, index: int) -> Frame:
        return dataclasses.replace(whole(self, index), cloud=PointCloud(np.full((5000, 3), np.nan, np.float32)))

    monkeypatch.setattr(RigPair, "__getitem__", empty)
    code, out, err = run(capsys, SOURCE, "--out", str(tmp_path / "out"))
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert "0 usable points" in err
    assert not (tmp_path / "out").exists()


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text("<html>mine</html>")
    cases = {
        ("--frame", "2"): "outside 0..1",
        ("--frame", "-1"): "outside 0..1",
        ("--out", str(tmp_path / "file")): "is a file",
        ("--out", str(tmp_path / "file" / "deeper")): "is a file",
        ("--out", str(tmp_path / "site")): "did not write",
        ("--initial", str(tmp_path / "none.json")): "none.json",
        ("--config", str(tmp_path / "none.yaml")): "none.yaml",
    }
    for arguments, text in cases.items():
        code, out, err = run(capsys, SOURCE, "--out", str(tmp_path / "out"), *arguments)
        assert (code, out) == (2, ""), arguments
        assert len(err.splitlines()) == 1, err
        assert text in err
    assert not (tmp_path / "out").exists()
    assert (tmp_path / "file").read_text() == "mine"
    assert (tmp_path / "site" / "index.html").read_text() == "<html>mine</html>"
    with pytest.raises(SystemExit, match="2"):
        main.main(["steps", SOURCE, "--frame", "first"])
    assert "--frame" in capsys.readouterr().err


def test_new_page_replaces_the_old_one(tmp_path: Path) -> None:
    picture = np.arange(600, dtype=np.uint8).reshape(20, 30)
    section = next(iter(SECTIONS))
    (tmp_path / "notes.png").write_bytes(b"mine")
    first = [Step(section, name, "what it is", picture) for name in ("One <step>", "Two")]
    page = write_page(tmp_path, "a & b", {"Source": "<here>"}, "x: 1", first)
    assert sorted(content(tmp_path)) == ["01_one_step.png", "02_two.png", "index.html", "notes.png"]
    text = page.read_text()
    assert "a &amp; b" in text
    assert "&lt;here&gt;" in text
    assert "One &lt;step&gt;" in text
    write_page(tmp_path, "c", {}, "", first[1:])
    assert sorted(content(tmp_path)) == ["01_two.png", "index.html", "notes.png"]

    def broken() -> object:
        yield first[0]
        raise ValueError("no more")

    before = content(tmp_path)
    with pytest.raises(ValueError, match="no more"):
        write_page(tmp_path, "d", {}, "", broken())  # type: ignore[arg-type]
    assert content(tmp_path) == before
    check_folder(tmp_path)


def test_the_initial_extrinsic(drive: SyntheticDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "start.json"
    Result(se3.exp([0, 0.01, 0, 0, 0, 0]) @ drive.reference, "initial").save(file)
    out = tmp_path / "out"
    code, _, err = run(capsys, SOURCE, "--out", str(out), "--initial", str(file))
    assert code == 0, err
    assert "start.json: x " in (out / "index.html").read_text()


def test_scales_order_colours_and_dots_stay_visible() -> None:
    near_is_bright = Scale("depth, m", 2, 60, VIRIDIS, log=True, falling=True)
    levels = near_is_bright.levels([1, 2, 11, 60, 100])
    assert levels.tolist() == [255, 255, 128, 1, 1]
    assert VIRIDIS[255].sum() > VIRIDIS[1].sum() > VIRIDIS[0].sum()
    dots = np.zeros((40, 1242), np.uint8)
    dots[20, 600], dots[20, 601] = 10, 200
    large = enlarged(dots)
    assert np.count_nonzero(large) == 3 * 4
    assert large[20, 600] == 200  # the higher level, that is the nearer point, lies on top
    interest = np.zeros((30, 50), np.float32)
    interest[12, 33] = 1
    rows, columns = busiest(interest, 8, 10)
    assert interest[rows, columns].sum() == 1
    assert (rows.stop - rows.start, columns.stop - columns.start) == (8, 10)
