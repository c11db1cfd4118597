"""What an HTML page shows, links and says."""

from __future__ import annotations

from html.parser import HTMLParser


class Page(HTMLParser):
    """ids, links (of <a>), sources (of pictures, all of which must have a text), tags, captions of figures, and all text."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.sources: list[str] = []
        self.captions: list[str] = []
        self.tags: set[str] = set()
        self.text = ""
        self._in_caption = False
        self.feed(content)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {key: value or "" for key, value in attrs}
        self.tags.add(tag)
        self.ids += [values["id"]] if "id" in values else []
        self.links += [values["href"]] if "href" in values else []
        self.sources += [values["src"]] if "src" in values else []
        assert tag != "img" or values["alt"]
        if tag == "figcaption":
            self._in_caption = True
            self.captions.append("")

    def handle_endtag(self, tag: str) -> None:
        self._in_caption &= tag != "figcaption"

    def handle_data(self, data: str) -> None:
        self.text += data
        if self._in_caption:
            self.captions[-1] += data
