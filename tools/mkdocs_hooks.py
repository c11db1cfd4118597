"""Hooks of the documentation site (mkdocs.yml): pages and links from outside docs/, and formulas without scripts.

The pages of docs/ link to the repository as GitHub shows it (`../calib_ros/camera.py`, `../config/calib_ros.yaml`). In the site
such a link leads to a page with that file's source. A link to a file that does not exist is a warning, which `--strict` makes an
error.
"""

from __future__ import annotations

import html
import logging
import posixpath
import re
from pathlib import Path
from typing import Any

from latex2mathml import converter
from mkdocs.structure.files import File, InclusionLevel

ROOT = Path(__file__).resolve().parents[1]
LOG = logging.getLogger("mkdocs.hooks.calib_ros")

# Files of the repository that are pages of the site.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "benchmarks/README.md": "benchmarks.md",
}
LANGUAGES = {".py": "python", ".yaml": "yaml", ".yml": "yaml", ".cff": "yaml", ".json": "json", ".xml": "xml", ".toml": "toml"}
LINK = re.compile(r"(?P<picture>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s]+)\)")
FENCE = re.compile(r"(```.*?```)", re.DOTALL)
FORMULA = re.compile(r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<tex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that stand outside docs/, and a source page for every file that a page links to."""
    texts = {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    for name, uri in PAGES.items():
        texts[name] = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, uri, content=texts[name]))
    linked = {_repository_path(page, target) for page, text in texts.items() for target in _links(text)}
    for name in sorted(linked):
        path = ROOT / name
        if path.is_file() and path.suffix != ".md" and not name.startswith("docs/"):
            page = File.generated(config, _source_uri(name), content=_source_page(name), inclusion=InclusionLevel.NOT_IN_NAV)
            files.append(page)
        elif path.is_file() and path.suffix in {".jpg", ".png", ".svg"} and files.get_file_from_path(name[5:]) is None:
            LOG.warning("%s is linked and no file of the site", name)
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn links to the repository into links within the site."""
    uri = page.file.src_uri
    if uri.startswith("source/"):
        return markdown
    name = next((name for name, of_page in PAGES.items() if of_page == uri), f"docs/{uri}")

    def replaced(match: re.Match[str]) -> str:
        target, text = match["target"], match["text"]
        if "://" in target or target.startswith(("#", "mailto:")):
            return match[0]
        repository_path, anchor = _repository_path(name, target), target.partition("#")[2]
        if not (ROOT / repository_path).exists():
            LOG.warning("%s links to %s, which does not exist", name, target)
        elif (ROOT / repository_path).is_dir():
            return text
        relative = posixpath.relpath(_site_path(repository_path), posixpath.dirname(uri) or ".")
        return f"{match['picture']}[{text}]({relative}{'#' + anchor if anchor else ''})"

    return "".join(part if part.startswith("```") else LINK.sub(replaced, part) for part in FENCE.split(markdown))


def on_page_content(content: str, page: Any, config: Any, files: Any) -> str:
    """Formulas become MathML."""

    def replaced(match: re.Match[str]) -> str:
        display = "block" if match["tag"] == "div" else "inline"
        formula = converter.convert(html.unescape(match["tex"]).strip(), display=display)
        if "\\" in formula:
            LOG.warning("%s has a formula that cannot be drawn: %s", page.file.src_uri, match["tex"])
        return f'<{match["tag"]} class="formula">{formula}</{match["tag"]}>'

    return FORMULA.sub(replaced, content)


def _links(text: str) -> list[str]:
    """Targets of the links of a page that lead to files."""
    found = [match["target"] for match in LINK.finditer(FENCE.sub("", text))]
    return [target for target in found if "://" not in target and not target.startswith(("#", "mailto:"))]


def _repository_path(page: str, target: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), target.partition("#")[0]))


def _site_path(repository_path: str) -> str:
    if repository_path in PAGES:
        return PAGES[repository_path]
    return repository_path[5:] if repository_path.startswith("docs/") else _source_uri(repository_path)


def _source_uri(name: str) -> str:
    return f"source/{name}.md"


def _source_page(name: str) -> str:
    language = LANGUAGES.get(Path(name).suffix, "text")
    text = (ROOT / name).read_text(encoding="utf-8")
    header = f"---\ntitle: {name}\nsearch:\n  exclude: true\nhide: [toc]\n---\n\n# {name}\n\n"
    return f'{header}````{language} linenums="1"\n{text}````\n'
