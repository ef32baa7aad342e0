"""Markdown extension for formulas in plain text: indented blocks, and subscripts.

``q_n`` and ``|F|_(n+1)`` get a subscript if a single letter or a norm stands before the underscore.
"""

import re
from xml.etree.ElementTree import Element

from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from markdown.treeprocessors import Treeprocessor
from markdown.util import AtomicString

BASE = r"(?:(?<=(?<!\w)\w)|(?<=(?<!\w)\w['²])|(?<=\|)|(?<=\|²))"
SUBSCRIPT = BASE + r"_([A-Za-z0-9*]+(?![A-Za-z0-9_])|\([^()]*\))"
# higher priority than Markdown's emphasis, lower than its code and links
INLINE_PRIORITY = 65
# higher priority than the colours of code, which are for blocks with fences
BLOCK_PRIORITY = 35


def lowered(match: re.Match[str]) -> Element:
    """Return the element of a subscript, without parentheses."""
    element = Element("sub")
    element.text = AtomicString(match[1].strip("()"))
    return element


class Subscripts(InlineProcessor):
    """Turn underscores in the text into subscripts."""

    def handleMatch(self, match: re.Match[str], data: str) -> tuple[Element, int, int]:
        return lowered(match), match.start(), match.end()


class Blocks(Treeprocessor):
    """Turn indented blocks into formulas, and their underscores into subscripts."""

    def run(self, root: Element) -> None:
        for block in root.iter("pre"):
            if len(block) != 1 or block[0].tag != "code":
                continue
            text = (block[0].text or "").rstrip()
            block.clear()
            block.tag = "div"
            block.set("class", "formula")
            last, end = None, 0
            for match in re.finditer(SUBSCRIPT, text):
                _append(block, last, text[end : match.start()])
                last, end = lowered(match), match.end()
                block.append(last)
            _append(block, last, text[end:])


def _append(block: Element, last: Element | None, text: str) -> None:
    """Add text to a block, after its last child."""
    if last is None:
        block.text = AtomicString(text)
    else:
        last.tail = AtomicString(text)


class Formulas(Extension):
    """The extension, for ``markdown_extensions`` of mkdocs."""

    def extendMarkdown(self, md: Markdown) -> None:
        md.inlinePatterns.register(Subscripts(SUBSCRIPT, md), "subscripts", INLINE_PRIORITY)
        md.treeprocessors.register(Blocks(md), "formulas", BLOCK_PRIORITY)
