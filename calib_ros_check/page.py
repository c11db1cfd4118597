"""The HTML pages: one file that needs no network, in a light and a dark theme, on a desk and on a phone."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from calib_ros.config import Config
from calib_ros.errors import MissingDependencyError
from calib_ros.io import write_atomically
from calib_ros.registration.judgement.refusal import lines_of

# Strings, so that they are installed with the code whatever installs it.
# The colours of all pages. Blue, amber and purple stay apart for all kinds of colour vision, on both papers.
LIGHT = (
    "--paper: #fbfbfa; --card: #ffffff; --ink: #1c1e21; --soft: #5d636b; --line: #dcdfe3; --accent: #0b62a8; "
    "--good: #0072b2; --doubtful: #a65f00; --bad: #a3246e; --neutral: #6b7178;"
)
DARK = (
    "--paper: #131518; --card: #1c1f23; --ink: #e6e8ea; --soft: #9aa2ab; --line: #33383e; --accent: #6db3f2; "
    "--good: #56b4e9; --doubtful: #e69f00; --bad: #f08ac0; --neutral: #9aa2ab;"
)
STYLE = (
    f":root {{ {LIGHT} }}\n@media (prefers-color-scheme: dark) {{ :root {{ {DARK} }} }}"
    + """
* { box-sizing: border-box; } html { scroll-behavior: smooth; }
body {
  margin: 0 auto; max-width: 1500px; padding: 1.5rem clamp(.8rem, 3vw, 2.5rem) 4rem; color: var(--ink);
  background: var(--paper); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif;
}
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 1rem; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; margin: 3rem 0 .2rem; padding-top: 1rem; border-top: 2px solid var(--line); }
h2 span, figcaption span { color: var(--soft); font-weight: 400; margin-right: .35rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; margin: 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
.intro { color: var(--soft); margin: 0 0 1rem; } a { color: var(--accent); }
nav {
  display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 15rem), 1fr)); gap: .5rem 1.5rem; margin: 1.5rem 0;
}
nav ol { list-style: none; margin: .2rem 0 0; padding: 0; font-size: .88rem; }
nav > div > a { font-weight: 600; } nav a { text-decoration: none; } nav a:hover { text-decoration: underline; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 34rem), 1fr)); gap: 1.2rem; align-items: start; }
figure {
  margin: 0; background: var(--card); border: 1px solid var(--line); border-radius: 8px; overflow: hidden;
  scroll-margin-top: 1rem; min-width: 0;
}
figure:target { outline: 2px solid var(--accent); } figure.wide { grid-column: 1 / -1; }
figure img { display: block; width: 100%; height: auto; background: #181818; }
figcaption { padding: .6rem .9rem .8rem; font-size: .93rem; } figcaption b { display: block; }
.scroll { overflow-x: auto; padding: .8rem .9rem 0; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .2rem 1.2rem .2rem 0; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { color: var(--soft); font-weight: 600; }
details { margin: 1rem 0; } summary { cursor: pointer; color: var(--accent); }
pre { overflow-x: auto; font-size: .82rem; background: var(--card); border: 1px solid var(--line); }
pre { padding: .8rem; border-radius: 8px; }
@media (max-width: 600px) { dl { grid-template-columns: 1fr; gap: 0; } dt { margin-top: .4rem; } nav ol { column-count: 2; } }
"""
)

PAGE = (
    """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="generator" content="calib-ros {{ command }}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{{ title }}</title>
<style>
"""
    + STYLE
    + """\
{% block style %}{% endblock %}
</style>
</head>
<body>
<header>
<h1>{{ title }}</h1>
<dl>
{% for name, value in facts.items() %}
<dt>{{ name }}</dt><dd>{{ value }}</dd>
{% endfor %}
</dl>
<details><summary>Configuration</summary><pre>{{ configuration }}</pre></details>
<nav>
{% block contents %}{% endblock %}
</nav>
</header>
<main>
{% block main %}{% endblock %}
</main>
</body>
</html>
"""
)


def page_template(template: str, **filters: Callable[..., Any]) -> Any:
    """Jinja template that fills the blocks style, contents and main of the page; rendered with command, title, facts and
    configuration. filters: by name, beside base64 and lines, of a reason. MissingDependencyError without Jinja2."""
    try:
        from jinja2 import DictLoader, Environment, StrictUndefined
    except ImportError:
        raise MissingDependencyError("the page needs Jinja2: pip install jinja2, or apt install python3-jinja2") from None
    loader = DictLoader({"base": PAGE, "page": '{% extends "base" %}\n' + template})
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, loader=loader)
    own = {"base64": lambda data: base64.b64encode(data).decode(), "lines": lambda reason: "\n".join(lines_of(reason))}
    environment.filters |= {**own, **filters}
    return environment.get_template("page")


def write_page(path: str | Path, template: Any, config: Config, facts: Mapping[str, str], **values: Any) -> None:
    """Write a page, atomically. template: see `page_template`; values: what it shows, but for the configuration. BadInputError if
    the folder cannot be written."""
    page = template.render(configuration=yaml.safe_dump(config.to_dict(), sort_keys=False), facts=facts, **values)
    write_atomically(path, page.encode("utf-8", "backslashreplace"))
