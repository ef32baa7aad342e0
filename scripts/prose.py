#!/usr/bin/env python3
"""Check the English of docstrings and comments:  scripts/prose.py [options] [files or folders]

Print each offence with its place, then the rates of each folder. With --quiet print only faults.
Exit with status 1 if a sentence is too long or begins badly, or if a comment stands behind code or
is too wide. Also exit with status 1 if a folder has too many of the vague words.
"""

import argparse
import ast
import io
import itertools
import re
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
# limits: words of a sentence, columns of a comment
LONGEST = 25
WIDEST = 88
# number of words from which the rates of a folder count
LEAST_WORDS = 200
# most of these words in 1,000, as counted in models of good style: PyFR, scikit-fem,
# lineax
VAGUE = {"what": 0.5, "one, ones, those, others, such": 3.6}
MARKS = ("type:", "noqa", "fmt:", "!", "pragma", "%%")
CITATION = re.compile(r"\([^()]*\b(?:19|20)\d\d\b[^()]*\)")
CODE = re.compile(r"``[^`]*``|`[^`]*`|^(?: {4,}|>>>|\|).*$", re.MULTILINE)


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Yield the first line's number and the text of each docstring."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and node.body:
            first = node.body[0]
            if text := ast.get_docstring(node):
                yield first.lineno, text


def comments(source: str) -> Iterator[tuple[int, str, bool, int]]:
    """Yield line number, text, whether code stands before it and last column of each comment.

    Comments on consecutive lines of their own are a single text.
    """
    block: list[tuple[int, str, bool, int]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        text = token.string[1:].strip()
        if token.type != tokenize.COMMENT or text.startswith(MARKS):
            continue
        line, behind = token.start[0], bool(token.line[: token.start[1]].strip())
        if block and not behind and block[-1][0] + block[-1][1].count("\n") + 1 == line:
            begin, before, _, width = block.pop()
            block.append((begin, f"{before}\n{text}", False, max(width, token.end[1])))
        else:
            yield from block
            block = [(line, text, behind, token.end[1])]
    yield from block


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a text without code, tables and citations."""
    text = CITATION.sub("", text)
    for paragraph in re.split(r"\n\s*\n|\n\s*[-*] ", CODE.sub("x", text)):
        yield from re.split(r"(?<=[.!?:;])\s+", " ".join(paragraph.split()))


def offences(path: Path, counts: Counter[str]) -> Iterator[tuple[int, str]]:
    """Yield line number and fault; add the words of the file to ``counts``."""
    source = path.read_text()
    texts = [(line, text) for line, text in docstrings(source)]
    texts += [(line, text) for line, text, _, _ in comments(source)]
    for line, _, behind, width in comments(source):
        if behind:
            yield line, "comment behind code: give it a line of its own above"
        elif width > WIDEST:
            yield line, f"comment of {width} columns, at most {WIDEST}"
    for line, text in texts:
        words = Counter(re.findall(r"[a-z']+", CODE.sub("", text).lower()))
        counts["words"] += words.total()
        for vague in VAGUE:
            number = sum(words[word] for word in vague.split(", "))
            counts[vague] += number
            if number:
                yield line, f"({number} of: {vague})"
        for sentence in sentences(text):
            if (length := len(sentence.split())) > LONGEST:
                yield line, f"sentence of {length} words: {sentence[:60]} ..."
            if re.match(r"(Of|Where|What) ", sentence):
                yield line, f"sentence begins with {sentence.split()[0]}: {sentence[:60]}"


def main() -> int:
    """Print the offences in the files; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    parser.add_argument("paths", nargs="*", type=Path, default=[ROOT / "msmpetsc"])
    parser.add_argument("--quiet", action="store_true", help="print faults alone, no counts")
    options = parser.parse_args()
    files = [sorted(path.rglob("*.py")) or [path] for path in options.paths]
    failed, folders = False, defaultdict[Path, Counter[str]](Counter)
    for file in itertools.chain.from_iterable(files):
        for line, fault in sorted(offences(file, folders[file.parent])):
            is_count = fault.startswith("(")
            failed |= not is_count
            if not (options.quiet and is_count):
                print(f"{file}:{line}: {fault}")
    for folder, counts in folders.items():
        rates = {vague: 1000 * counts[vague] / max(counts["words"], 1) for vague in VAGUE}
        over = any(rate > VAGUE[vague] for vague, rate in rates.items())
        failed |= over and counts["words"] > LEAST_WORDS
        shown = ", ".join(f"{rate:.1f} of {vague!r}" for vague, rate in rates.items())
        if not options.quiet or over:
            print(f"{folder}: {counts['words']} words; in 1,000: {shown}{' - too many' * over}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
