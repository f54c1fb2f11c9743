"""Pages that need no other file and no network: templates by Jinja, which escapes whatever a recording is called."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup


def page(template: str, **content: Any) -> str:
    """A whole page.

    Args:
        template: name of a file in ``templates/``.
        content: what it needs; texts are escaped, images are PNG files and provenance is a mapping.
    """
    content["provenance"] = yaml.safe_dump(dict(content["provenance"]), sort_keys=False, allow_unicode=True)
    return _environment().get_template(template).render(content)


def embedded(data: bytes) -> str:
    """A file as base64, to stand in a page."""
    return base64.b64encode(data).decode("ascii")


def script_data(content: Mapping[str, Any]) -> Markup:
    """JSON for a ``<script>`` element: no text in it can end the element."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


@cache
def plotly() -> Markup:
    """The script of Plotly's basic bundle."""
    return Markup((files("fgloc.evaluation") / "assets" / "plotly-basic.min.js").read_text(encoding="utf-8"))


@cache
def _environment() -> Environment:
    loader = PackageLoader("fgloc.evaluation")
    return Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
