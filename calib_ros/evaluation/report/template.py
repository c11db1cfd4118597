"""The HTML of the report. A string, so that it is installed with the code whatever installs it."""

from calib_ros.evaluation.steps.page_template import TEMPLATE as STEPS

# It looks like the page of the steps.
LOOKS = STEPS.partition("<style>")[2].partition("</style>")[0]

TEMPLATE = (
    """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="generator" content="calib-ros evaluate">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{{ title }}</title>
<style>"""
    + LOOKS
    + """\
.sheet { background: var(--card); border: 1px solid var(--line); border-radius: 8px; margin: 0 0 1.2rem; min-width: 0; }
.sheet h3, figcaption b { font-size: 1rem; font-weight: 600; }
.sheet h3 { margin: 0; padding: .7rem .9rem 0; }
.sheet p { margin: .5rem .9rem .7rem; font-size: .85rem; color: var(--soft); }
.sheet td, .sheet th { text-align: right; padding: .2rem 0 .2rem 1.4rem; }
.sheet td.text, .sheet th.text { text-align: left; white-space: normal; min-width: 6rem; }
.sheet td:first-child, .sheet th:first-child { padding-left: 0; white-space: nowrap; }
.sheet td.best { font-weight: 700; color: var(--accent); }
figure .scroll { padding: 0; }
figure .scroll img { max-width: none; margin: 0 auto; background: #ffffff; }
figure.wide .scroll img { min-width: 46rem; }
.said { margin: 0 0 1.2rem; padding-left: 1.2rem; }
.methods { margin: 0 0 1.2rem; font-size: .93rem; }
.methods dt { color: var(--ink); font-weight: 600; }
.swatch { display: inline-block; width: 1.4rem; height: .35rem; border-radius: 2px; margin-right: .6rem; vertical-align: middle; }
nav ol { font-size: .95rem; columns: 2 16rem; }
nav { display: block; }
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
<nav><ol>
{% for section in sections %}
<li><a href="#{{ section.key }}">{{ loop.index }} {{ section.heading }}</a></li>
{% endfor %}
</ol></nav>
</header>
<main>
{% for section in sections %}
<section>
<h2 id="{{ section.key }}"><span>{{ loop.index }}</span>{{ section.heading }}</h2>
<p class="intro">{{ section.introduction }}</p>
{% if section.sentences %}
<ul class="said">
{% for sentence in section.sentences %}
<li>{{ sentence }}</li>
{% endfor %}
</ul>
{% endif %}
{% if section.methods %}
<dl class="methods">
{% for name, what, color in section.methods %}
<dt><span class="swatch" style="background:{{ color }}"></span>{{ name }}</dt><dd>{{ what }}</dd>
{% endfor %}
</dl>
{% endif %}
{% for table in section.tables %}
<div class="sheet">
<h3>{{ table.title }}</h3>
<div class="scroll"><table>
<tr>{% for cell in table.header %}<th class="{{ table.looks(-1, loop.index0) }}">{{ cell }}</th>{% endfor %}</tr>
{% for row in table.rows %}
{% set r = loop.index0 %}
<tr>{% for cell in row %}<td class="{{ table.looks(r, loop.index0) }}">{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</table></div>
{% for note in table.notes %}
<p>{{ note }}</p>
{% endfor %}
</div>
{% endfor %}
<div class="grid">
{% for plot in section.plots %}
<figure{% if plot.wide %} class="wide"{% endif %}>
<div class="scroll"><img src="data:image/png;base64,{{ plot.png|base64 }}" width="{{ plot.size[0] }}" height="{{ plot.size[1] }}"
 alt="{{ plot.title }}"></div>
<figcaption><b>{{ plot.title }}</b>{{ plot.caption }}</figcaption>
</figure>
{% endfor %}
{% for picture in section.pictures %}
<figure>
<img src="data:image/jpeg;base64,{{ picture|jpeg|base64 }}" width="{{ picture.image.shape[1] }}"
 height="{{ picture.image.shape[0] }}" alt="{{ picture.title }}">
<figcaption><b>{{ picture.title }}</b>{{ picture.caption }}</figcaption>
</figure>
{% endfor %}
</div>
</section>
{% endfor %}
</main>
</body>
</html>
"""
)
