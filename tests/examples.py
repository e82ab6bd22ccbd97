"""Code blocks of Markdown pages, run as a reader would run them: one after the other, in one namespace."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from typing import NamedTuple

__all__ = ["Example", "examples_of", "run_examples"]

_EXAMPLE = re.compile(r"^```python\n(?P<code>.*?)^```\n(?:\n```text\n(?P<output>.*?)^```\n)?", re.DOTALL | re.MULTILINE)


class Example(NamedTuple):
    """A Python block of a page."""

    code: str
    line: int
    """of the page, before the code's first"""
    output: str | None
    """what it prints, where a ``text`` block stands right below it"""


def examples_of(page: Path) -> list[Example]:
    """The Python blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [Example(m["code"], text.count("\n", 0, m.start("code")), m["output"]) for m in _EXAMPLE.finditer(text)]


def run_examples(page: Path) -> None:
    """Run the Python blocks of a page.

    :raise AssertionError: one prints something else than the page says
    """
    namespace: dict[str, object] = {"__name__": "__main__"}
    for example in examples_of(page):
        printed = io.StringIO()
        # empty lines first, so that a traceback names the line of the page
        code = compile("\n" * example.line + example.code, str(page), "exec")
        with contextlib.redirect_stdout(printed):
            exec(code, namespace)
        if example.output is not None and _tidy(printed.getvalue()) != _tidy(example.output):
            raise AssertionError(f"{page}, line {example.line + 1}: it prints\n{printed.getvalue()}")


def _tidy(text: str) -> list[str]:
    return [line.rstrip() for line in text.strip().splitlines()]
