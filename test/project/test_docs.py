"""The documentation is consistent with the repository: links, code, parameters, commands, pictures, the length of the README."""

from __future__ import annotations

import csv
import importlib
import re
from pathlib import Path

import cv2
import pytest
import yaml
from paths import ROOT

from calib_ros import __version__
from calib_ros.cli.main import main
from calib_ros.config import Config
from calib_ros.config.removed import REMOVED
from calib_ros.online.tracker import TRANSITIONS, TrackerEvent, TrackerState
from calib_ros.ros.parameters import SETTINGS

DOCUMENT = ROOT / "docs/method.md"
PICTURES = ROOT / "docs/method"
TEXT = DOCUMENT.read_text(encoding="utf-8")
WIDTH = 900  # px of a picture
STEP, SAME = 24, 0.005  # grey levels that a pixel may differ by, as other versions of OpenCV do; share that may differ by more
README_WORDS = 1500
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("docs/*.md")), *sorted(ROOT.glob("*/README.md"))]


def prose(document: Path) -> str:
    """A page without its code and formulas."""
    return re.sub(r"```.*?```", "", document.read_text(encoding="utf-8"), flags=re.DOTALL)


PROSE = prose(DOCUMENT)
SHOWN = re.findall(r"!\[([^\]]*)\]\((method/[^)]+)\)\n\n(.*)", PROSE)


def anchors(document: Path) -> set[str]:
    """Of the headings of a document, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", prose(document), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links(document: Path) -> list[tuple[str, str]]:
    """Text and target of every link and picture that leads into the repository."""
    found = re.findall(r"\[([^\]]*)\]\(([^)\s]+)\)", prose(document))
    return [(text, target) for text, target in found if "://" not in target]


def test_links_lead_to_existing_files_and_headings() -> None:
    broken = []
    for page in PAGES:
        for _, link in links(page):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
                broken.append(f"{page.name}: {link}")
    assert not broken, "\n".join(broken)


def test_links_to_code_name_what_that_module_defines() -> None:
    """A link's text is `module.function` or `module.Class.method`, its target the module's file."""
    wrong = []
    for page in PAGES:
        for text, link in links(page):
            file = (page.parent / link).resolve()
            if file.suffix != ".py" or not re.fullmatch(r"`[\w.]+`", text):
                continue
            stem, *attributes = text.strip("`").split(".")
            found = importlib.import_module(".".join(file.relative_to(ROOT).with_suffix("").parts))
            for attribute in attributes if attributes != ["py"] else []:
                found = getattr(found, attribute, None)
            if found is None or stem != file.stem:
                wrong.append(f"{page.name}: {text} is not in {link}")
    assert not wrong, "\n".join(wrong)


def test_parameters_in_the_text_exist() -> None:
    known = {f"{stage}.{name}" for stage, values in Config().to_dict().items() for name in values}
    known |= {*SETTINGS}
    stages = {name.partition(".")[0] for name in known if "." in name}
    unknown = []
    for page in PAGES:
        without_links = re.sub(r"\[`[^\]]*\]\([^)]*\)", "", prose(page))
        for name in re.findall(r"`(\w+\.\w+)(?:: [\w.]+)?`", without_links):
            gone = page.name == "CHANGELOG.md" and name in REMOVED
            if name.partition(".")[0] in stages and name not in known and not gone and not name.endswith((".py", ".md", ".csv")):
                unknown.append(f"{page.name}: {name}")
    assert not unknown, "\n".join(unknown)


def test_tables_of_figures_are_linked_and_whole() -> None:
    """A line of column names, then rows of as many cells; a page says where each comes from."""
    linked = {(page.parent / link).resolve() for page in PAGES for _, link in links(page) if link.endswith(".csv")}
    tables = sorted((ROOT / "docs/figures").glob("*.csv"))
    assert linked == {path.resolve() for path in tables}
    for path in tables:
        with path.open(encoding="utf-8", newline="") as file:
            header, *rows = csv.reader(file)
        assert len(set(header)) == len(header), path.name
        assert rows, path.name
        assert {len(row) for row in rows} == {len(header)}, path.name


def test_the_table_of_states_is_that_of_the_tracker() -> None:
    rows = [["from", *(event.name.lower().replace("_", " ") for event in TrackerEvent)]]
    for state in TrackerState:
        after = (TRANSITIONS.get((state, event)) for event in TrackerEvent)
        rows.append([state.name.lower(), *(there.name.lower() if there else "" for there in after)])
    shown = re.findall(r"^\| (?:from|initial|tentative|confirmed|lost) .*$", (ROOT / "docs/online.md").read_text(), re.MULTILINE)
    assert [[cell.strip() for cell in line.split("|")[1:-1]] for line in shown] == rows


def test_commands_in_the_text_exist() -> None:
    """`python -m benchmarks.NAME` and the like are modules of the repository."""
    for page in PAGES:
        for module in re.findall(r"python3? -m (benchmarks\.[a-z_]+)", page.read_text(encoding="utf-8")):
            path = ROOT / module.replace(".", "/")
            assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), f"{page.name}: {module}"


def test_files_in_the_text_exist() -> None:
    """Paths in backticks whose first folder is one of the repository, and tests in commands."""
    missing = []
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            continue
        in_commands = re.findall(r"test/[\w./]+", page.read_text(encoding="utf-8"))
        for path in [*in_commands, *re.findall(r"`([\w.]+/[\w./]+)`", prose(page))]:
            if (ROOT / path.partition("/")[0]).is_dir() and not (ROOT / path).exists() and path != "site/":
                missing.append(f"{page.name}: {path}")
    assert not missing, "\n".join(missing)


def test_the_readme_is_short_enough_to_scan() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= README_WORDS


def test_the_citation_names_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == __version__
    assert citation["license"] in (ROOT / "package.xml").read_text(encoding="utf-8")


def test_issue_forms_ask_for_what_a_report_needs() -> None:
    forms = {f.stem: yaml.safe_load(f.read_text(encoding="utf-8")) for f in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml")}
    fields = {stem: {field.get("id") for field in form.get("body", [])} for stem, form in forms.items()}
    assert fields["extrinsic"] >= {"seen", "sensors", "capture", "version"}
    assert fields["defect"] >= {"steps", "version"}


def test_every_page_is_in_the_navigation_of_the_site() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    assert {page.name for page in (ROOT / "docs").glob("*.md")} <= set(re.findall(r": (\w+\.md)", navigation))


def test_every_equation_and_algorithm_of_chapter_3_occurs() -> None:
    for number in range(1, 17):
        first = re.search(rf"3\.{number}\b", TEXT)
        in_range = any(int(a) <= number <= int(b) for a, b in re.findall(r"3\.(\d+) to 3\.(\d+)", TEXT))
        assert first or in_range, f"eq. 3.{number}"
    for number in range(9, 17):
        assert re.search(rf"3\.{number}\b(?!\.\d)", TEXT), f"eq. 3.{number}"
    for number in range(1, 7):
        assert re.search(rf"[Aa]lgorithm {number}\b", TEXT), f"algorithm {number}"


def test_fences_are_closed_and_braces_match() -> None:
    assert TEXT.count("```") % 2 == 0
    for equation in [*re.findall(r"```math\n(.*?)```", TEXT, flags=re.DOTALL), *re.findall(r"\$([^$\n]+)\$", PROSE)]:
        assert equation.replace(r"\{", "").count("{") == equation.replace(r"\}", "").count("}"), equation
        assert len(re.findall(r"\\left\b", equation)) == len(re.findall(r"\\right\b", equation)), equation
    for line in PROSE.splitlines():
        assert line.count("$") % 2 == 0, line


def test_the_pictures_are_small_and_all_shown_with_words_and_captions() -> None:
    assert all(len(words) > 15 and caption.startswith("*") for words, _, caption in SHOWN)
    files = sorted(PICTURES.iterdir())
    assert [file.name for file in files] == sorted(Path(path).name for _, path, _ in SHOWN)
    assert sum(file.stat().st_size for file in files) < 2e6
    assert {cv2.imread(str(file)).shape[1] for file in files} == {WIDTH}


@pytest.mark.slow
def test_the_pictures_are_those_of_the_steps(tmp_path: Path) -> None:
    command = re.search(r"`calib-ros (steps synthetic\S* .*?) --out steps`", " ".join(TEXT.split()))
    assert command is not None
    assert main([*command[1].split(), "--out", str(tmp_path)]) == 0
    made = {file.stem.partition("_")[2]: file for file in tmp_path.glob("*.png")}
    for file in PICTURES.iterdir():
        shown, new = cv2.imread(str(file)), cv2.imread(str(made[file.stem]))
        size = shown.shape[1] // 4, shown.shape[0] // 4  # where JPEG's colours are those of the pixels
        shown, new = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in (shown, new))
        assert (cv2.absdiff(shown, new).max(axis=2) > STEP).mean() < SAME, file.name
