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
from dataclasses import dataclass, field
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


@dataclass
class Structure:
    """arrows: (room, room) -> an example 'file imports module'. files: (module, module) -> the same, between files."""

    arrows: dict[tuple[str, str], str] = field(default_factory=dict)
    files: dict[tuple[str, str], str] = field(default_factory=dict)

    @classmethod
    def read(cls, packages: Sequence[str] = PACKAGES) -> Structure:
        """Of the packages as they lie in the repository."""
        own = cls()
        for package in packages:
            for path in package_files(package):
                here = module_of(path)
                for module in imports_of(path):
                    if module.split(".")[0] not in packages:
                        continue
                    example = f"{path.relative_to(ROOT)} imports {module}"
                    if module != here:
                        own.files.setdefault((here, module), example)
                    if room_of(module) != room_of(here):
                        own.arrows.setdefault((room_of(here), room_of(module)), example)
        return own

    @property
    def rooms(self) -> set[str]:
        """All that import or are imported."""
        return {room for arrow in self.arrows for room in arrow}


def circles(arrows: Mapping[tuple[str, str], str]) -> list[list[str]]:
    """Sets of names that import each other, directly or through others."""
    names = sorted({name for arrow in arrows for name in arrow})
    ends = np.array([[names.index(name) for name in arrow] for arrow in arrows], int).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(arrows)), ends), (len(names), len(names)))
    count, part = connected_components(graph, connection="strong")
    found = [[name for name, own in zip(names, part, strict=True) if own == k] for k in range(count)]
    return [circle for circle in found if len(circle) > 1]


def floors(arrows: Mapping[tuple[str, str], str]) -> dict[str, int]:
    """Room -> floor from 0, the ground. ValueError where rooms form a circle."""
    if circles(arrows):
        raise ValueError("rooms that import each other lie on no floor")
    out: dict[str, int] = {}

    def floor(room: str) -> int:
        if room not in out:
            out[room] = 1 + max((floor(b) for a, b in arrows if a == room), default=-1)
        return out[room]

    for room in {room for arrow in arrows for room in arrow}:
        floor(room)
    return out


def constants(path: Path) -> int:
    """Names in capitals that a module assigns."""
    count = 0
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        names = [n for t in targets for n in (t.elts if isinstance(t, ast.Tuple) else [t])]
        count += sum(isinstance(n, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", n.id) is not None for n in names)
    return count


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


def counts(all_files: Structure) -> dict[str, dict[str, int]]:
    """What has a ceiling: section -> name -> count."""
    files = {package: package_files(package) for package in (*PACKAGES, *LABORATORY, "test")}
    lines = {package: sum(p.read_text(encoding="utf-8").count("\n") for p in own) for package, own in files.items()}
    # Programs at the top, in docs/ and launch/ count as well.
    named = {path for own in files.values() for path in own}
    rest = [p for pattern in ("*.py", "docs/**/*.py", "launch/*.py") for p in ROOT.glob(pattern) if p not in named]
    lines["all_but_test"] = sum(n for package, n in lines.items() if package != "test")
    lines["all_but_test"] += sum(path.read_text(encoding="utf-8").count("\n") for path in rest)
    outside = [path for package, own in files.items() if package != "test" for path in own]
    other = {
        "files_of_calib_ros": len(files[CORE]),
        "options": options(),
        "words_of_docs": words(),
        "classes_outside_tests": sum(map(classes, outside)),
        "circles": len(circles(all_files.files)) + len(circles(all_files.arrows)),
    }
    return {"lines": lines, "counts": other}


def ceilings() -> configparser.ConfigParser:
    """Of tools/ceilings.toml; its few lines are INI as well, which every Python reads."""
    read = configparser.ConfigParser()
    read.read_string(CEILINGS.read_text(encoding="utf-8"))
    return read


def above(found: Mapping[str, Mapping[str, int]]) -> list[str]:
    """A line for each count that is above its ceiling, or has none."""
    read = ceilings()
    limits = {section: {name: read.getint(section, name, fallback=-1) for name in found[section]} for section in found}
    return [
        f"{section}.{name}: {count}, ceiling {limits[section][name]}"
        for section, own in found.items()
        for name, count in own.items()
        if count > limits[section][name]
    ]


def lower(found: Mapping[str, Mapping[str, int]]) -> None:
    """Writes the counts into the file of ceilings where they are less."""
    text = CEILINGS.read_text(encoding="utf-8")
    for name, count in (item for own in found.values() for item in own.items()):
        if limit := re.search(rf"(?m)^{name} = (\d+)$", text):
            text = text[: limit.start(1)] + str(min(count, int(limit[1]))) + text[limit.end(1) :]
    CEILINGS.write_text(text, encoding="utf-8")


def _table(found: Mapping[str, Mapping[str, int]]) -> list[str]:
    rows = []
    for package, lines in found["lines"].items():
        files = package_files(package) if package != "all_but_test" else []
        row = (len(files), lines, sum(map(classes, files)), sum(map(constants, files)))
        rows.append(f"{package:24s}" + "".join(f"{n:10d}" if n else f"{'':10s}" for n in row))
    head = f"{'':24s}" + "".join(f"{name:>10s}" for name in ("files", "lines", "classes", "constants"))
    return [head, *rows, *(f"{name.replace('_', ' ')}: {count}" for name, count in found["counts"].items())]


def main() -> int:
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--arrows", action="store_true", help="print what imports what")
    asked.add_argument("--check", action="store_true", help=f"compare with {CEILINGS.name} only")
    asked.add_argument("--lower", action="store_true", help=f"lower {CEILINGS.name} to what is reached")
    args = asked.parse_args()
    everything = Structure.read((*PACKAGES, *LABORATORY))
    found = counts(everything)
    if args.lower:
        lower(found)
    if args.check or args.lower:
        print("\n".join(too_many := above(found)), end="\n" if too_many else "")
        return int(bool(too_many))
    structure = Structure.read()
    print("\n".join(_table(found)))
    print(f"rooms {len(structure.rooms)}, arrows {len(structure.arrows)}")
    of_rooms = circles(structure.arrows)
    for circle in (*circles(everything.arrows), *circles(everything.files)):
        print("  circle: " + ", ".join(circle))
    if not of_rooms:
        on = floors(structure.arrows)
        for number in sorted(set(on.values()), reverse=True):
            print(f"  floor {number}: " + ", ".join(sorted(room for room in on if on[room] == number)))
    if args.arrows:
        for (a, b), example in sorted(structure.arrows.items()):
            print(f"  {a} -> {b}: {example}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
