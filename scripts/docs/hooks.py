"""Hooks of mkdocs: put README files and all linked files on the site, and fill in tables.

Pages are in ``pages/``; README files and results stay where they are in the tree. A link in a page
leads to a file of the tree; on the site it leads to the page of this file.
"""

import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pygments.formatters import HtmlFormatter

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
PAGES = HERE / "pages"
LINK = re.compile(r"(\]\()([^)#\s]+)(#[^)\s]*)?(\))")
sys.path[:0] = [str(HERE), str(ROOT)]

from formulas import Formulas  # noqa: E402
from reference_tables import with_tables  # noqa: E402


@cache
def tracked() -> tuple[Path, ...]:
    """Return the Markdown files of the tree outside ``pages/`` that go on the site."""
    patterns = [":(glob)*.md", ":(glob)**/README.md", ":(glob)scripts/results/*.md"]
    words = ["git", "ls-files", "-z", "--", *patterns]
    names = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return tuple(ROOT / name for name in names.split("\0") if name and (ROOT / name).exists())


def address(path: Path) -> str:
    """Return the address on the site of a file of the tree."""
    if path == ROOT / "README.md":
        return "index.md"
    if PAGES in path.parents:
        page = path.relative_to(PAGES).as_posix()
        return page.replace(".py", ".md") if is_tutorial(path) else page
    return path.relative_to(ROOT).as_posix()


def is_tutorial(path: Path) -> bool:
    """Return whether a file is a tutorial: a script of percent cells."""
    return path.parent == PAGES / "tutorials" and path.suffix == ".py"


def page_of_script(text: str) -> str:
    """Return a script of percent cells as Markdown."""
    parts = []
    for part in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        title, _, body = part.partition("\n")
        if title.strip() == "[markdown]":
            parts.append(re.sub(r"^# ?", "", body, flags=re.MULTILINE).strip())
        else:
            parts.append(f"```python\n{body.strip()}\n```")
    return "\n\n".join(parts) + "\n"


def linked(path: Path, text: str) -> dict[str, Path]:
    """Return the files of the tree that a text links to, by the target as written."""
    files = {}
    for _, target, _, _ in LINK.findall(text):
        file = Path(os.path.normpath(path.parent / target))
        if "://" not in target and ROOT in file.parents and file.is_file():
            files[target] = file
    return files


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Let Markdown know formulas."""
    config.markdown_extensions.append(Formulas())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add README files, results, tutorials, all files that they or pages link to, and colours."""
    colours = HtmlFormatter().get_style_defs(".highlight")
    files.append(File.generated(config, "pygments.css", content=colours))
    texts = {path: path.read_text() for path in (*tracked(), *PAGES.rglob("*.md"))}
    for path in PAGES.glob("tutorials/*.py"):
        texts[path] = page_of_script(path.read_text())
        files.append(File.generated(config, address(path), content=texts[path]))
    there = {file.src_uri for file in files}
    for path in tracked():
        files.append(File.generated(config, address(path), abs_src_path=str(path)))
        there.add(address(path))
    for path, text in texts.items():
        for file in linked(path, text).values():
            if address(file) not in there:
                files.append(File.generated(config, address(file), abs_src_path=str(file)))
                there.add(address(file))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page with its tables, and with links that hold on the site."""
    uri = page.file.src_uri
    path = next((path for path in tracked() if address(path) == uri), PAGES / uri)
    folder = Path(uri).parent

    def replaced(match: re.Match[str]) -> str:
        before, target, anchor, after = match.groups()
        if target not in targets:
            return match[0]
        own = os.path.relpath(address(targets[target]), folder)
        return f"{before}{own}{anchor or ''}{after}"

    targets = linked(path, markdown)
    return with_tables(LINK.sub(replaced, markdown))
