"""What all pages look like: colours of a light and a dark theme, a bar, and a list of the keys."""

from __future__ import annotations

from collections.abc import Mapping

from nicegui import events, ui

ACCENT = "#0b62a8"
STYLE = """
:root {
  --paper: #fbfbfa; --card: #ffffff; --ink: #1c1e21; --soft: #5d636b; --line: #dcdfe3; --accent: #0b62a8; --mark: #c2410c;
}
.body--dark {
  --paper: #131518; --card: #1c1f23; --ink: #e6e8ea; --soft: #9aa2ab; --line: #33383e; --accent: #6db3f2; --mark: #fb923c;
}
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


def apply() -> ui.dark_mode:
    """Style and colours of this page; as the system is set, until somebody chooses."""
    ui.colors(primary=ACCENT)
    ui.add_css(STYLE)
    ui.add_head_html(KEYS_AFTER_CLICK + HEIGHT_OF_BAR)
    return ui.dark_mode(None)


def icon_button(icon: str, hint: str, on_click: object, key: str = "") -> ui.button:
    """A small button. key: that does the same, told in the hint."""
    button = ui.button(icon=icon, on_click=on_click).props(f'flat dense color=primary aria-label="{hint}"')  # type: ignore[arg-type]
    with button:
        ui.tooltip(f"{hint} ({key})" if key else hint)
    return button


def switch(dark: ui.dark_mode) -> None:
    """Between the light and the dark theme; at first it is as the browser has it."""
    dark.value = dark.value is not True


def pressed(event: events.KeyEventArguments, *dialogs: ui.dialog) -> str:
    """Name of the key that goes down; "" for none, with Ctrl, Alt or Meta, or behind an open dialog."""
    held = event.modifiers.ctrl or event.modifiers.alt or event.modifiers.meta
    return "" if not event.action.keydown or held or any(dialog.value for dialog in dialogs) else event.key.name


def keys_dialog(keys: Mapping[str, str]) -> ui.dialog:
    """What the keys do."""
    with ui.dialog() as dialog, ui.card().classes("card"):
        ui.label("Keys").classes("text-lg font-semibold")
        with ui.grid(columns="max-content 1fr").classes("gap-x-4 gap-y-1"):
            for key, what in keys.items():
                ui.html(f"<kbd>{key}</kbd>", sanitize=False)
                ui.label(what)
        ui.button("Close", on_click=dialog.close).props("flat dense no-caps autofocus")
    return dialog
