"""The page of a rig: all sensors at once, of a recording or of a running node; the pages of its pairs are a link away."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from nicegui import events, run, ui

from calib_ros_view.session.rig_session import RigSession
from calib_ros_view.session.rig_shown import Pair
from calib_ros_view.web import theme
from calib_ros_view.web.panels import RigScene
from calib_ros_view.web.rig_words import CSS, edges_html, graph_svg, legend, loops_html, sensors_html
from calib_ros_view.web.server import Pictures

if TYPE_CHECKING:
    from calib_ros_view.node.rig_watch import RigWatch

TICK_S = 0.5  # between two looks at what there is
KEYS = {"n / p": "next / previous moment of a recording", "t": "light or dark", "?": "this list"}


def address_of(pair: Pair) -> str:
    """Of the page of a pair."""
    return f"/pair/{'/'.join(pair)}"


class RigPage:
    """What one browser sees of a rig."""

    def __init__(self, feed: RigSession | RigWatch, pictures: Pictures) -> None:
        self._feed, self._pictures = feed, pictures
        self._seen = -1
        self._tiles: dict[str, ui.element] = {}
        self._links: dict[str, Sequence[Pair]] = {}
        self._busy = False

    def build(self) -> None:
        """Lay the page out, and keep it up to date until the browser leaves."""
        self._dark = theme.apply()
        ui.add_css(CSS)
        self._keys = theme.keys_dialog(KEYS)
        with ui.header(elevated=False).classes("bar items-center gap-1 px-2 py-1 wrap"):
            ui.label(self._feed.name).classes("text-base font-semibold ellipsis").props("role=heading aria-level=1")
            ui.space()
            if isinstance(self._feed, RigSession):
                theme.icon_button("chevron_left", "previous moment", partial(self._go, -1), "p")
                self._moment = ui.label().classes("figures text-sm")
                theme.icon_button("chevron_right", "next moment", partial(self._go, 1), "n")
            theme.icon_button("contrast", "light or dark", partial(theme.switch, self._dark), "t")
            theme.icon_button("help_outline", "keys", self._keys.open, "?")
        with ui.element("main").classes("rig"):
            with self._part("", whole=True).props("role=status aria-live=polite"):
                self._text = ui.label().mark("summary")
                self._problem = ui.label().classes("bad sign").mark("problem")
                ui.html(legend(), sanitize=False).classes("text-xs soft")
            with self._part("Cameras, with the points of their LiDARs"):
                self._grid = ui.element("div").classes("tiles")
            with self._part("Sensors and edges"):
                self._graph = ui.html("", sanitize=False)
            with self._part("Sensors", whole=True):
                self._sensors = ui.html("", sanitize=False)
            with self._part("Edges", whole=True):
                self._edges = ui.html("", sanitize=False)
            with self._part("Clouds and cameras, in the frame of the reference"):
                self._scene = RigScene()
            with self._part("Loops"):
                self._loops = ui.html("", sanitize=False)
        ui.keyboard(on_key=self._key, ignore=["input", "select", "textarea"])
        ui.timer(TICK_S, self._tick)

    def _part(self, title: str, whole: bool = False) -> ui.element:
        part = ui.element("section").classes("card p-2 min-w-0" + " whole" * whole)
        if title:
            with part:
                ui.html(f"<h2>{title}</h2>", sanitize=False)
        return part

    def _key(self, event: events.KeyEventArguments) -> None:
        key = theme.pressed(event, self._keys)
        if key in ("n", "p") and isinstance(self._feed, RigSession):
            ui.timer(0, partial(self._go, 1 if key == "n" else -1), once=True)
        elif key == "t":
            theme.switch(self._dark)
        elif key == "?":
            self._keys.open()

    async def _go(self, by: int) -> None:
        if not self._busy and isinstance(self._feed, RigSession):
            self._busy = True
            try:
                await run.io_bound(self._feed.go, by)
            finally:
                self._busy = False

    async def _tick(self) -> None:
        """Show what has changed."""
        feed, rig = self._feed, self._feed.rig
        if not isinstance(feed, RigSession):
            feed.look()
        if rig is None:
            return
        await self._scene.show(rig, dict(feed.clouds), feed.corners)
        if self._seen == feed.version:
            return
        self._seen = feed.version
        self._text.text = rig.text
        self._problem.text = feed.problem
        self._problem.set_visibility(bool(self._problem.text))
        if isinstance(feed, RigSession):
            self._moment.text = f"{feed.moment + 1} of {len(feed.moments)}"
        for part, content in (
            *((self._graph, graph_svg(rig)), (self._sensors, sensors_html(rig))),
            *((self._edges, edges_html(rig)), (self._loops, loops_html(rig))),
        ):
            if part.content != content:
                part.set_content(content)
        self._show_tiles()

    def _show_tiles(self) -> None:
        """Only addresses change, so that a link keeps the focus, unless there are others."""
        links = {tile: self._feed.pairs_of(tile) for tile in sorted(self._feed.tiles)}
        if links != self._links:
            self._links = links
            self._grid.clear()
            with self._grid:
                self._tiles = {tile: self._tile(tile, pairs) for tile, pairs in links.items()}
        for tile, picture in self._tiles.items():
            picture.props(f'src="{self._pictures.put(f"rig {tile}", self._feed.tiles[tile])}"')

    def _tile(self, tile: str, pairs: Sequence[Pair]) -> ui.element:
        with ui.element("figure").classes("m-0"):
            if pairs:
                with ui.link(target=address_of(pairs[0])).props(f'aria-label="open {" with ".join(pairs[0])}"'):
                    picture = ui.element("img")
            else:
                picture = ui.element("img")
            with ui.element("figcaption").classes("text-sm"):
                for pair in pairs:
                    ui.link(" with ".join(pair), address_of(pair))
                if not pairs:
                    ui.label(f"{tile}: no LiDAR's points are in view")
        return picture.props(f'alt="{tile}, with points over the image"')
