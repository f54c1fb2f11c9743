"""What the documentation's build adds: the command line's reference, maths as MathML, the list of decisions."""

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


def command_line() -> str:
    """Every command with its arguments and options, from the program itself."""
    from fgloc.cli import app

    command = get_command(app)
    context = typer.Context(command, info_name="fgloc")
    return get_docs_for_click(obj=command, ctx=context, name="fgloc", title="Command line")


def decisions() -> str:
    """A page that lists the decision records by their titles."""
    lines = ["# Decisions", "", "A page each: the context, the options with their figures, the decision.", ""]
    for path in sorted((DOCS / "decisions").glob("[0-9]*.md")):
        title = path.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")
        lines.append(f"- [{title}]({path.name})")
    return "\n".join(lines) + "\n"


def on_files(files, config):
    """Add the pages that are generated."""
    for name, content in (("reference/cli.md", command_line()), ("decisions/index.md", decisions())):
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown, page, config, files):
    """Name files outside the documents by their paths: only the repository has them."""
    folder = (DOCS / page.file.src_uri).parent

    def plain(match):
        text, target = match[1], match[2].partition("#")[0]
        outside = target and not target.startswith("http") and not (folder / target).resolve().is_relative_to(DOCS)
        if not outside:
            return match[0]
        path = (folder / target).resolve().relative_to(DOCS.parent).as_posix()
        return f"`{path}`" if path in text or text in path else f"{text} (`{path}`)"

    if page.file.src_uri == "index.md":  # only the site has this page
        markdown = re.sub(r"command line \(`fgloc --help`[^)]*\)", "[command line](reference/cli.md)", markdown)
    markdown = re.sub(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)", plain, markdown)
    return markdown.replace("](decisions/)", "](decisions/index.md)")


def on_page_content(html, page, config, files):
    """LaTeX to MathML, which browsers draw without a script."""

    def inline(match):
        return convert(unescape(match[1]))

    def display(match):
        return f"<p>{convert(unescape(match[1]), display='block')}</p>"

    html = re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', inline, html, flags=re.DOTALL)
    return re.sub(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', display, html, flags=re.DOTALL)
