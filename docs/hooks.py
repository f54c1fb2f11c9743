"""Steps of the documentation's build: the command line's reference, maths as MathML, links to files off the site."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path

import typer
from latex2mathml.converter import convert
from mkdocs.structure.files import File
from typer.cli import get_docs_for_click
from typer.main import get_command

DOCS = Path(__file__).resolve().parent
FOR_CONTRIBUTORS = (DOCS / "decisions", DOCS / "architecture.md")  # not on the site


def command_line() -> str:
    """Every command with its arguments and options, from the program itself."""
    from fgloc.cli import app

    command = get_command(app)
    context = typer.Context(command, info_name="fgloc")
    return get_docs_for_click(obj=command, ctx=context, name="fgloc", title="Command line")


def on_files(files, config):
    """Add the page that is generated."""
    files.append(File.generated(config, "reference/cli.md", content=command_line()))
    return files


def on_page_markdown(markdown, page, config, files):
    """Replace links to files that only the repository has by their paths."""
    folder = (DOCS / page.file.src_uri).parent

    def plain(match):
        text, target = match[1], match[2].partition("#")[0]
        if not target or target.startswith("http"):
            return match[0]
        file = (folder / target).resolve()
        if file.is_relative_to(DOCS) and not any(file.is_relative_to(part) for part in FOR_CONTRIBUTORS):
            return match[0]
        path = file.relative_to(DOCS.parent).as_posix()
        return f"`{path}`" if path in text or text in path else f"{text} (`{path}`)"

    if page.file.src_uri == "index.md":  # only the site has this page
        markdown = re.sub(r"command line \(`fgloc --help`[^)]*\)", "[command line](reference/cli.md)", markdown)
    return re.sub(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)", plain, markdown)


def on_page_content(html, page, config, files):
    """LaTeX to MathML, which browsers draw without a script."""

    def inline(match):
        return convert(unescape(match[1]))

    def display(match):
        return f"<p>{convert(unescape(match[1]), display='block')}</p>"

    html = re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', inline, html, flags=re.DOTALL)
    return re.sub(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', display, html, flags=re.DOTALL)
