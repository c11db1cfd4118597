"""What all pages look like: colours of a light and a dark theme, a bar, and a list of the keys."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial

from nicegui import events, ui

from calib_ros_check.page import DARK, LIGHT

ACCENT = "#0b62a8"
STYLE = (
    f":root {{ {LIGHT} --mark: #c2410c; }}\n.body--dark {{ {DARK} --mark: #fb923c; }}"
    + """
body {
  background: var(--paper); color: var(--ink);
  font: 15px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif;
}
.nicegui-content { padding: 0; gap: 0; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 8px; }
.soft { color: var(--soft); }
.figures { font-variant-numeric: tabular-nums; }
.bar { background: var(--card); color: var(--ink); border-bottom: 1px solid var(--line); }
.bar .q-btn { min-width: 2.2rem; }
.body--dark :is(.q-btn--flat, .q-slider, .q-linear-progress) { --q-primary: var(--accent); }
svg.plot { width: 100%; height: auto; display: block; color: var(--soft); }
svg.plot .now { stroke: var(--mark); } svg.plot .curve { stroke: var(--accent); fill: none; stroke-width: 1.6; }
svg.plot text { fill: currentColor; font-size: 11px; }
kbd { background: var(--paper); border: 1px solid var(--line); border-radius: 4px; padding: 0 .35em; font-size: .9em; }
.plain input::-webkit-inner-spin-button { display: none; }
.plain input { text-align: right; }
.stays { position: sticky; top: calc(var(--bar, 3rem) + .4rem); z-index: 2; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 1px; }
"""
)
# A tab, a slider or a button that was clicked would keep the arrow keys, which move the cloud. Whoever comes to it by the Tab key
# (a click without detail) keeps it, and so do fields in which one types or chooses, until Escape.
KEYS_AFTER_CLICK = """<script>
document.addEventListener('click', (e) => {
  if (e.detail && !e.target.closest('.q-field, .q-dialog')) document.activeElement?.blur();
});
document.addEventListener('keydown', (e) => {
  if (e.key == 'Escape' && !e.target.closest('.q-dialog')) document.activeElement?.blur();
}, true);
</script>"""
# The bar has as many lines as the screen is narrow; what stays in view does so below it.
HEIGHT_OF_BAR = """<script>
addEventListener('load', () => new ResizeObserver(([bar]) =>
  document.documentElement.style.setProperty('--bar', bar.borderBoxSize[0].blockSize + 'px')
).observe(document.querySelector('.bar')));
</script>"""


@contextmanager
def bar(title: str, keys: Mapping[str, str], back: str = "") -> Iterator[tuple[Callable[[], None], ui.dialog]]:
    """Style of a page, and its bar: title, way back to the rig, what is laid out inside the context, theme, list of the keys.
    Gives what switches the theme, which is as the system's until then, and the list."""
    ui.colors(primary=ACCENT)
    ui.add_css(STYLE)
    ui.add_head_html(KEYS_AFTER_CLICK + HEIGHT_OF_BAR)
    dark = ui.dark_mode(None)

    def switch() -> None:
        dark.value = dark.value is not True

    with ui.dialog() as listed, ui.card().classes("card"):
        ui.label("Keys").classes("text-lg font-semibold")
        with ui.grid(columns="max-content 1fr").classes("gap-x-4 gap-y-1"):
            for key, what in keys.items():
                ui.html(f"<kbd>{key}</kbd>", sanitize=False)
                ui.label(what)
        ui.button("Close", on_click=listed.close).props("flat dense no-caps autofocus")
    with ui.header(elevated=False).classes("bar items-center gap-1 px-2 py-1 wrap"):  # it wraps on a narrow screen
        if back:
            icon_button("hub", "all sensors of the rig", partial(ui.navigate.to, back))
        name = ui.label(title).classes("text-base font-semibold ellipsis").style("max-width: 45vw")
        name.props("role=heading aria-level=1")
        yield switch, listed
        icon_button("contrast", "light or dark", switch, "t")
        icon_button("help_outline", "keys", listed.open, "?")


def icon_button(icon: str, hint: str, on_click: object, key: str = "") -> ui.button:
    """A small button. key: that does the same, told in the hint."""
    button = ui.button(icon=icon, on_click=on_click).props(f'flat dense color=primary aria-label="{hint}"')  # type: ignore[arg-type]
    with button:
        ui.tooltip(f"{hint} ({key})" if key else hint)
    return button


def pressed(event: events.KeyEventArguments, *dialogs: ui.dialog) -> str:
    """Name of the key that goes down; "" for none, with Ctrl, Alt or Meta, or behind an open dialog."""
    held = event.modifiers.ctrl or event.modifiers.alt or event.modifiers.meta
    return "" if not event.action.keydown or held or any(dialog.value for dialog in dialogs) else event.key.name
