"""A strict reader of HTML reports."""

from html.parser import HTMLParser


class HtmlReader(HTMLParser):
    """Collects text, table rows and pictures; fails on badly nested tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.strings: list[tuple[str, str]] = []
        self.rows: list[list[str]] = []
        self.numeric: list[list[bool]] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "img":
            self.images.append(dict(attrs))
        elif tag != "meta":
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
            self.numeric.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
            self.numeric[-1].append("class" in dict(attrs))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.strings.append((self.open[-1], " ".join(data.split())))
            if self.open[-1] in ("td", "th"):
                self.rows[-1][-1] += data

    def text(self, *tags: str) -> str:
        """All text directly inside these tags."""
        return "\n".join(text for tag, text in self.strings if tag in tags)

    def row(self, first: str) -> list[str]:
        """The table row with this first cell."""
        return next(row for row in self.rows if row[0] == first)
