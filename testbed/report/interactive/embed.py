"""What makes a page work without anything else: BokehJS, our scripts, and styles, as text to put into it."""

from __future__ import annotations

import functools
import importlib.util
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from testbed.errors import UserError

BOKEH = ("bokeh.min.js", "bokeh-api.min.js")
SCRIPTS = ("state.js", "plots.js", "map.js", "controls.js")  # in this order
LIVE = "live.js"  # after those, of a run in progress
STATIC = Path(__file__).parent / "static"


def script(contents: Mapping[str, Any]) -> str:
    """Everything that is run in a page which shows these contents; one that has "live" listens for newer ones.

    Raises UserError when BokehJS is missing.
    """
    names = (*SCRIPTS, LIVE) if "live" in contents else SCRIPTS
    own = "\n".join((STATIC / name).read_text("utf-8") for name in names)
    # Within a script element "<" could begin the end of it, or a comment.
    shown = json.dumps(contents, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'{_bokeh()}\n(() => {{\n"use strict";\nconst PAGE = {shown};\n{own}\n}})();'


def styles() -> str:
    """The style sheet of a page."""
    return (STATIC / "page.css").read_text("utf-8")


@functools.cache
def _bokeh() -> str:
    """BokehJS, as its Python package brings it; that is not imported, which would take longer than to draw a figure."""
    found = importlib.util.find_spec("bokeh")
    places = found.submodule_search_locations if found is not None else None
    if not places:
        raise UserError("bokeh is not installed, which draws report.html: install it, or run with --no-report")
    folder = Path(places[0]) / "server" / "static" / "js"
    return "\n".join((folder / name).read_text("utf-8") for name in BOKEH)
