"""HTML of pages: one function that puts values into markup, and escapes them, and one that makes a whole page.

Names of photos, notes, figures of a run: all of it may be somebody else's. Values enter HTML by `markup` alone. A page
states a Content-Security-Policy by which nothing is loaded and only its own scripts run, known by their hashes.
"""

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template
from typing import Any

from markupsafe import Markup

from .. import __version__

EMPTY = Markup()
_POLICY = "default-src 'none'; script-src {}; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; "
_POLICY += "form-action 'none'"


def markup(template: str, *values: Any, **keywords: Any) -> Markup:
    """Return a template of HTML with values in its fields, as of str.format; text is escaped, Markup is not.

    template: a literal, never text from outside.
    """
    return Markup(template).format(*values, **keywords)


def join(parts: Iterable[Any], separator: str = "") -> Markup:
    """Return parts of HTML one after another; those that are plain text are escaped. separator: a literal."""
    return Markup(separator).join(parts)


def json_block(name: str, value: Any) -> Markup:
    """Return a <script> element that holds plain values as JSON and runs nothing; `name` is its id."""
    text = json.dumps(value).replace("<", "\\u003c")
    return markup('<script type="application/json" id="{}">{}</script>', name, Markup(text))


def data_block(packed: str, **attributes: str) -> Markup:
    """Return a <script> element that holds base64 and runs nothing."""
    extra = join(markup(' {}="{}"', name.replace("_", "-"), value) for name, value in attributes.items())
    return markup('<script type="text/plain"{}>{}</script>', extra, packed)


def with_code(text: str) -> Markup:
    """Return text whose `commands` between backticks are marked as code."""
    return join(markup("<code>{}</code>", part) if index % 2 else part for index, part in enumerate(text.split("`")))


def page_file(name: str) -> str:
    """Return the text of a file in the folder `page`."""
    return Path(__file__).parent.joinpath("page", name).read_text(encoding="utf-8")


def page_markup(name: str, **values: Any) -> Markup:
    """Return a file of HTML in the folder `page` with values in place of its $names; text is escaped."""
    return Markup(Template(page_file(name)).substitute({key: markup("{}", each) for key, each in values.items()}))


def whole_page(title: str, style: str, body: Markup, scripts: Sequence[str], *, workers: bool = False) -> str:
    """Return a page that needs no other file.

    Args:
        title: Plain text.
        style: CSS of the page, placed after style.css.
        body: HTML.
        scripts: JavaScript of the program's own, run in this order at the end of the page.
        workers: Whether these scripts start workers from their own text.
    """
    scripts = [text.replace("</script", "<\\/script") for text in scripts]
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts]
    policy = _POLICY.format(" ".join(f"'sha256-{each}'" for each in hashes))
    return page_markup(
        "page.html",
        policy=f"{policy}; worker-src blob:" if workers else policy,
        title=title,
        version=__version__,
        style=Markup(page_file("style.css") + style),
        body=body,
        scripts=join((markup("<script>{}</script>", Markup(text)) for text in scripts), "\n"),
    )
