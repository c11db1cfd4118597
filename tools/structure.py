#!/usr/bin/env python3
"""The structure of the repository, read from its imports: packages, rooms, floors, arrows, circles; options, constants, words.

`python tools/structure.py` prints the tables; `--arrows` also what imports what, with an example each. A room is a folder of a
package, or a module that lies in the package itself. An arrow is an import from one room into another, type hints included; rooms
lie on the floor above the highest one that they import from.

`--check` compares the counts with the ceilings in tools/ceilings.toml; exit code 1 and a line for each count that is above its
ceiling. `--lower` writes what is reached where that is less.
"""

from __future__ import annotations

import argparse
import ast
import configparser
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[1]
CEILINGS = ROOT / "tools" / "ceilings.toml"
CORE = "calib_ros"
BESIDE = tuple(f"{CORE}_{name}" for name in ("thesis", "semantics", "check", "view", "synthetic"))
PACKAGES = (CORE, *BESIDE)
LABORATORY = ("calib_ros_evaluation", "benchmarks", "tools")
# Values and files that everything may use: the modules in the core's own folder, but for these, which are rooms of their own.
VALUES = "values"
NO_VALUES = ("overlay", "export", "extensions")


def package_files(package: str) -> list[Path]:
    """Its Python files."""
    return sorted(path for path in (ROOT / package).rglob("*.py") if "__pycache__" not in path.parts)


def module_of(path: Path) -> str:
    """Name of a file's module."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    """'calib_ros.registration.score.atlas' -> 'calib_ros/registration'; modules of values and packages beside are one room."""
    package, _, rest = module.partition(".")
    if package != CORE:
        return package
    first = rest.partition(".")[0]
    if not first:
        return f"{CORE}/api"  # the public names, which nothing below takes
    if first == "__main__":
        return f"{CORE}/cli"
    is_folder = first != "config" and (ROOT / CORE / first).is_dir()
    return f"{CORE}/{first}" if is_folder or first in NO_VALUES else f"{CORE}/{VALUES}"


def imports_of(path: Path, hints: bool = True) -> list[str]:
    """Modules that a file imports, anywhere in it; with or without those for type checking alone."""
    found: list[str] = []

    def walk(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and not hints and "TYPE_CHECKING" in ast.dump(child.test):
                continue
            if isinstance(child, ast.Import):
                found.extend(alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module:
                found.extend(_names(child.module, [alias.name for alias in child.names]))
            walk(child)

    walk(ast.parse(path.read_text(encoding="utf-8")))
    return found


def _names(module: str, names: Sequence[str]) -> list[str]:
    """What `from module import names` imports: modules where they are some."""
    folder = ROOT / module.replace(".", "/")
    return sorted(
        {f"{module}.{name}" if (folder / f"{name}.py").exists() or (folder / name).is_dir() else module for name in names}
    )


Arrows = dict[tuple[str, str], str]  # who imports whom -> an example 'file imports module'


def arrows_of(packages: Sequence[str] = PACKAGES) -> tuple[Arrows, Arrows]:
    """Between rooms, and between modules, of the packages as they lie in the repository."""
    rooms, files = Arrows(), Arrows()
    for path in (path for package in packages for path in package_files(package)):
        here = module_of(path)
        for module in imports_of(path):
            if module.split(".")[0] in packages and module != here:
                example = f"{path.relative_to(ROOT)} imports {module}"
                files.setdefault((here, module), example)
                if room_of(module) != room_of(here):
                    rooms.setdefault((room_of(here), room_of(module)), example)
    return rooms, files


def circles(arrows: Arrows) -> list[list[str]]:
    """Sets of names that import each other, directly or through others."""
    names = sorted({name for arrow in arrows for name in arrow})
    ends = np.array([[names.index(name) for name in arrow] for arrow in arrows], int).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(arrows)), ends), (len(names), len(names)))
    count, part = connected_components(graph, connection="strong")
    found = [[name for name, own in zip(names, part, strict=True) if own == k] for k in range(count)]
    return [circle for circle in found if len(circle) > 1]


def floors(arrows: Arrows) -> dict[str, int]:
    """Room -> floor from 0, the ground, of rooms that form no circle."""
    on = {room: 0 for arrow in arrows for room in arrow}
    for _ in on:
        for above, below in arrows:
            on[above] = max(on[above], on[below] + 1)
    return on


def options() -> int:
    """Fields of all stages of the configuration, with the node's own settings."""
    from calib_ros.config import Config
    from calib_ros.ros.parameters import SETTINGS

    return sum(len(values) for values in Config().to_dict().values()) + len(SETTINGS)


def words() -> int:
    """Of the pages below docs/."""
    return sum(len(page.read_text(encoding="utf-8").split()) for page in ROOT.glob("docs/**/*.md"))


def classes(path: Path) -> int:
    """Classes that a module defines, nested ones too."""
    return sum(isinstance(node, ast.ClassDef) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def counts() -> dict[str, dict[str, int]]:
    """What has a ceiling: section -> name -> count."""
    files = {package: package_files(package) for package in (*PACKAGES, *LABORATORY, "test")}
    lines = {package: sum(p.read_text(encoding="utf-8").count("\n") for p in own) for package, own in files.items()}
    # Programs at the top, in docs/ and launch/ count as well.
    named = {path for own in files.values() for path in own}
    rest = [p for pattern in ("*.py", "docs/**/*.py", "launch/*.py") for p in ROOT.glob(pattern) if p not in named]
    lines["all_but_test"] = sum(n for package, n in lines.items() if package != "test")
    lines["all_but_test"] += sum(path.read_text(encoding="utf-8").count("\n") for path in rest)
    other = {
        "files_of_calib_ros": len(files[CORE]),
        "options": options(),
        "words_of_docs": words(),
        "classes_outside_tests": sum(classes(path) for package, own in files.items() if package != "test" for path in own),
        "circles": sum(len(circles(arrows)) for arrows in arrows_of((*PACKAGES, *LABORATORY))),
    }
    return {"lines": lines, "counts": other}


def ceilings() -> dict[str, dict[str, int]]:
    """As `counts`, of tools/ceilings.toml; its few lines are INI as well, which every Python reads."""
    read = configparser.ConfigParser()
    read.read_string(CEILINGS.read_text(encoding="utf-8"))
    return {section: {name: read.getint(section, name) for name in read.options(section)} for section in read.sections()}


def above(found: Mapping[str, Mapping[str, int]]) -> list[str]:
    """A line for each count that is above its ceiling, or has none."""
    limits = ceilings()
    return [
        f"{section}.{name}: {count}, ceiling {limits[section].get(name, -1)}"
        for section, own in found.items()
        for name, count in own.items()
        if count > limits[section].get(name, -1)
    ]


def lower(found: Mapping[str, Mapping[str, int]]) -> None:
    """Writes the counts into the file of ceilings where they are less."""
    text = CEILINGS.read_text(encoding="utf-8")
    for name, count in (item for own in found.values() for item in own.items()):
        text = re.sub(rf"(?m)^{name} = (\d+)$", lambda m, n=name, c=count: f"{n} = {min(c, int(m[1]))}", text)  # type: ignore[misc]
    CEILINGS.write_text(text, encoding="utf-8")


def main() -> int:
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--arrows", action="store_true", help="print what imports what")
    asked.add_argument("--check", action="store_true", help=f"compare with {CEILINGS.name} only")
    asked.add_argument("--lower", action="store_true", help=f"lower {CEILINGS.name} to what is reached")
    args = asked.parse_args()
    found = counts()
    if args.lower:
        lower(found)
    if args.check or args.lower:
        print("\n".join(too_many := above(found)), end="\n" if too_many else "")
        return int(bool(too_many))
    print(f"{'':24s}" + "".join(f"{name:>10s}" for name in ("files", "lines", "classes")))
    for package, lines in found["lines"].items():
        files = package_files(package) if package != "all_but_test" else []
        row = (len(files), lines, sum(map(classes, files)))
        print((f"{package:24s}" + "".join(f"{n or '':10}" for n in row)).rstrip())
    print("\n".join(f"{name.replace('_', ' ')}: {count}" for name, count in found["counts"].items()))
    for circle in (one for arrows in arrows_of((*PACKAGES, *LABORATORY)) for one in circles(arrows)):
        print("  circle: " + ", ".join(circle))
    rooms, _ = arrows_of()
    if not circles(rooms):
        on = floors(rooms)
        for number in sorted(set(on.values()), reverse=True):
            print(f"  floor {number}: " + ", ".join(sorted(room for room in on if on[room] == number)))
    if args.arrows:
        for (a, b), example in sorted(rooms.items()):
            print(f"  {a} -> {b}: {example}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
