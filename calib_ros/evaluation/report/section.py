"""A section of the report."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.evaluation.report.pictures import Picture
from calib_ros.evaluation.report.plots import Plot
from calib_ros.evaluation.report.table import Table


@dataclass(frozen=True)
class Section:
    """key: of links, a lower-case word. introduction: how to read it. sentences: what was found, in words. methods: name, title
    and colour of each, where they are explained. What is shown comes in the order of the fields."""

    key: str
    heading: str
    introduction: str
    sentences: tuple[str, ...] = ()
    methods: tuple[tuple[str, str, str], ...] = ()
    tables: tuple[Table, ...] = ()
    plots: tuple[Plot, ...] = ()
    pictures: tuple[Picture, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to show but the introduction."""
        return not (self.sentences or self.tables or self.plots or self.pictures)
