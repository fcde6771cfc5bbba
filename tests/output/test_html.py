"""Markup escapes what goes in, and no other module makes any."""

import ast
import json
import re
from pathlib import Path

import pytest

from sehdr_warp import output
from sehdr_warp.output.html import join, json_block, markup, whole_page, with_code


@pytest.mark.parametrize("path", sorted(Path(output.__file__).parent.rglob("*.py")), ids=lambda path: path.name)
def test_no_markup_is_made_but_by_the_one_function(path):
    """F-strings escape nothing, so only the one function may make markup of text."""
    for node in ast.walk(ast.parse(path.read_text())):
        for part in node.values if isinstance(node, ast.JoinedStr) else ():
            if isinstance(part, ast.Constant):
                assert not re.search(r"<[a-zA-Z/!]", part.value), f"{path.name}:{node.lineno}"
        name = getattr(getattr(node, "func", None), "id", "")
        if name == "markup":
            assert isinstance(node.args[0], ast.Constant | ast.Name), f"{path.name}:{node.lineno}"
        assert name != "Markup" or path.name == "html.py", f"{path.name}:{node.lineno}"


def test_text_is_escaped_and_markup_is_not():
    assert markup("<p>{}</p>", "<b \"'&>") == "<p>&lt;b &#34;&#39;&amp;&gt;</p>"
    assert markup('<p title="{name}">{}</p>', markup("<i>{}</i>", "<"), name='"') == '<p title="&#34;"><i>&lt;</i></p>'
    assert join(["<", markup("<br>")], "|") == "&lt;|<br>"
    assert with_code("run `<a>` now") == "run <code>&lt;a&gt;</code> now"
    block = json_block("facts", {"name": "</script><script>"})
    assert block.count("<script") == 1 and json.loads(block[block.index(">") + 1 : -9]) == {"name": "</script><script>"}


def test_a_page_runs_its_own_scripts_alone():
    scripts = ["let a = '</script>'", "let b"]
    text = whole_page("<T>", "p { color: red }", markup("<p>{}</p>", "<"), scripts)
    assert "<title>&lt;T&gt;</title>" in text and "p { color: red }" in text and "<p>&lt;</p>" in text
    ran = re.findall(r"<script>(.*?)</script>", text)
    assert ran == [r"let a = '<\/script>'", "let b"]
    assert text.count("&#39;sha256-") == 2 and "worker-src" not in text
