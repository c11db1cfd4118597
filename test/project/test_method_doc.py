"""docs/method.md says nothing that is not there: links, pictures, functions; and its pictures are those of the code."""

from __future__ import annotations

import importlib
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from paths import ROOT

DOCUMENT = ROOT / "docs/method.md"
PICTURES = ROOT / "docs/method"
TOOL = ROOT / "tools/method_pictures.py"
TEXT = DOCUMENT.read_text(encoding="utf-8")
PROSE = re.sub(r"```.*?```", "", TEXT, flags=re.DOTALL)
LINKS = sorted(set(re.findall(r"\]\(([^)\s]+)\)", PROSE)))
CODE_LINKS = sorted(set(re.findall(r"\[`([\w.]+)`\]\((\.\./calib_ros(?:_evaluation)?/[\w/]+\.py)\)", PROSE)))
SHOWN = re.findall(r"!\[([^\]]*)\]\(([^)]+)\)\n\n(.*)", PROSE)
QUICK = "kinds.jpg"  # needs one frame and no optimisation


def anchors(document: Path) -> set[str]:
    """Of the headings of a document, as GitHub makes them."""
    text = re.sub(r"```.*?```", "", document.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("method_pictures", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("link", LINKS)
def test_links_lead_somewhere(link: str) -> None:
    path, _, anchor = link.partition("#")
    assert not path.startswith(("http", "/")), "only what is in the repository"
    target = (DOCUMENT.parent / path).resolve() if path else DOCUMENT
    assert target.exists()
    if anchor:
        assert anchor in anchors(target)


@pytest.mark.parametrize(("name", "path"), CODE_LINKS)
def test_what_a_code_link_names_is_in_that_module(name: str, path: str) -> None:
    file = (DOCUMENT.parent / path).resolve()
    stem, *attributes = name.split(".")
    assert stem == file.stem
    found = importlib.import_module(".".join(file.relative_to(ROOT).with_suffix("").parts))
    for attribute in attributes if attributes != ["py"] else []:
        found = getattr(found, attribute)


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


def test_pictures_have_words_and_captions() -> None:
    for words, path, caption in SHOWN:
        assert len(words) > 15, path
        assert caption.startswith("*"), path


def test_the_pictures_are_those_of_the_tool_and_small(tool: ModuleType) -> None:
    files = {p.name for p in PICTURES.iterdir()}
    assert files == set(tool.PICTURES) == {Path(path).name for _, path, _ in SHOWN}
    assert sum(p.stat().st_size for p in PICTURES.iterdir()) < 3e6
    for file in PICTURES.iterdir():
        picture = cv2.imread(str(file))
        assert picture is not None, file.name
        assert 800 <= picture.shape[1] <= tool.WIDTH, file.name


def test_a_picture_is_made_as_it_is_in_the_folder() -> None:
    done = subprocess.run([sys.executable, TOOL, "--check", QUICK], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr


def test_a_picture_that_is_missing_or_another_is_told(tool: ModuleType, tmp_path: Path) -> None:
    file = PICTURES / QUICK
    picture = cv2.imread(str(file))
    picture[:30, :300] = 255 - picture[:30, :300]
    other = bytes(cv2.imencode(".jpg", picture)[1])
    assert tool.differs(file, file.read_bytes()) == ""
    assert "of the pixels" in tool.differs(file, other)
    assert "instead of" in tool.differs(file, bytes(cv2.imencode(".png", np.zeros((9, 9, 3), np.uint8))[1]))
    assert tool.differs(tmp_path / QUICK, other) == "missing"
