"""Boxes, arrows and words of the diagrams, as SVG."""

from html import escape
from pathlib import Path

STYLE = """
    text { font-family: sans-serif; font-size: 13px; fill: #1c2e40; }
    .box { fill: #f3f6fa; stroke: #35506b; stroke-width: 1.5; }
    .good { fill: #e3f1e5; stroke: #2f6b3a; stroke-width: 1.5; }
    .bad { fill: #fbeae2; stroke: #a34708; stroke-width: 1.5; }
    .line { fill: none; stroke: #35506b; stroke-width: 1.5; }
    .thin { fill: none; stroke: #c3ccd6; stroke-width: 1; }
    .arrow { fill: none; stroke: #35506b; stroke-width: 1.8; marker-end: url(#tip); }
    .title { font-weight: bold; }
    .note { font-size: 11px; fill: #4b5a68; }
"""
TIP = (
    '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
    'orient="auto"><path d="M0 0 L8 4 L0 8 z" fill="#35506b"/></marker></defs>'
)


class Drawing:
    """A diagram of some width and height in pixels; y downwards."""

    def __init__(self, width: int, height: int) -> None:
        self.parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
            f"<style>{STYLE}</style>",
            TIP,
            f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        ]

    def text(self, x: float, y: float, words: str, kind: str = "", anchor: str = "middle") -> None:
        """Write words whose baseline is at y."""
        self.parts.append(f'<text x="{x:g}" y="{y:g}" class="{kind}" text-anchor="{anchor}">{escape(words)}</text>')

    def box(self, centre: tuple[float, float], size: tuple[float, float], lines: str, kind: str = "box") -> None:
        """Draw a box with a title and notes, one line each."""
        (x, y), (width, height) = centre, size
        self.parts.append(
            f'<rect x="{x - width / 2:g}" y="{y - height / 2:g}" width="{width:g}" height="{height:g}" rx="8" '
            f'class="{kind}"/>'
        )
        title, *notes = lines.split("\n")
        top = y - 8.5 * len(notes) + 5
        self.text(x, top, title, "title")
        for row, note in enumerate(notes, 1):
            self.text(x, top + 17 * row, note, "note")

    def path(self, commands: str, kind: str = "arrow") -> None:
        """Draw a line of SVG path commands."""
        self.parts.append(f'<path d="{commands}" class="{kind}"/>')

    def circle(self, x: float, y: float, radius: float, kind: str) -> None:
        self.parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" class="{kind}"/>')

    def save(self, file: Path) -> None:
        file.write_text("\n".join([*self.parts, "</svg>"]) + "\n")
