"""Parts of pages that need no other file and no network."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

_CSS = """
:root { --ink: #1c2330; --soft: #5b6472; --line: #e3e6ea; --tint: #f5f7f9; --accent: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: 66rem; color: var(--ink); background: #fff;
       font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.6rem; margin: 0 0 .2rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid var(--line); padding-bottom: .25rem; }
p.sub, figcaption, td.why { color: var(--soft); }
code, pre { font: 13px/1.45 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
pre { background: var(--tint); padding: .8rem 1rem; overflow-x: auto; border-radius: 6px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(5.6rem, 1fr)); gap: .7rem; margin: 1.2rem 0; }
.tile { background: var(--tint); border-radius: 8px; padding: .7rem .8rem; }
.tile b { display: block; font-size: 1.15rem; white-space: nowrap; font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: .85rem; }
figure { margin: 1rem 0 1.6rem; } figure img { width: 100%; height: auto; display: block; }
figcaption { font-size: .9rem; margin-top: .3rem; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .3rem .8rem .3rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; } td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.warn { border-left: 4px solid #d55e00; background: #fdf3ec; padding: .6rem 1rem; }
.wide { overflow-x: auto; } .judged td:first-child { white-space: nowrap; font-variant-numeric: tabular-nums; }
.columns { display: flex; flex-wrap: wrap; gap: 0 2.5rem; } .columns > section { flex: 1 1 20rem; }
"""


def page(name: str, body: Iterable[str]) -> str:
    """A whole page; ``name`` is escaped already."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>fgloc: {name}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def table(head: Sequence[str], rows: Iterable[Sequence[object]], numbers: int) -> str:
    """A table whose last `numbers` columns are aligned right; empty without rows."""
    first = len(head) - numbers

    def line(cells: Sequence[object], tag: str) -> str:
        looks = ("" if i < first else ' class="n"' for i in range(len(cells)))
        inside = (f"<{tag}{look}>{escape(str(cell))}</{tag}>" for look, cell in zip(looks, cells, strict=True))
        return f"<tr>{''.join(inside)}</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f"<table>{line(head, 'th')}{body}</table>" if body else ""


def picture(data: bytes, alt: str, caption: str) -> str:
    """A PNG inside the page, with its caption."""
    code = base64.b64encode(data).decode("ascii")
    image = f'<img alt="{alt}" src="data:image/png;base64,{code}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
