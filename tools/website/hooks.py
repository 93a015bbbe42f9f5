"""A hook of MkDocs: the pages of docs/ as a site, with what they link to outside docs/ and formulas as MathML.

    pip install -e ".[docs]" && mkdocs build --strict

The pages stay as GitHub shows them. Links to files outside docs/ become links to copies on the site, comments go, and
formulas ($...$, $`...`$, blocks of math) become MathML, which browsers draw without scripts.
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
PAGES = {  # outside docs/, by their place on the site
    "about.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "log.md": "results/README.md",
}
LINK = re.compile(r"(?P<head>\]\()(?P<path>[^)\s:#]+)(?P<tail>#[^)\s]*)?\)")
CODE = r"^```(?!math)[\s\S]*?^```$|(?<!\$)`[^`\n]+`"
MATH = re.compile(rf"(?P<code>{CODE})|^```math\n(?P<block>[\s\S]*?)^```$|\$\$(?P<line>.+?)\$\$|\$`(?P<quoted>[^`]+)`\$|"
                  r"(?<![\w$\\])\$(?P<plain>[^$`\n]+)\$(?![\w$])", re.MULTILINE)  # fmt: skip


def source_of(place: str) -> PurePosixPath:
    """The file of the repository that a page of the site is made of."""
    return PurePosixPath(PAGES.get(place, f"docs/{place}"))


def place_of(file: str) -> str:
    """Where the site has a file of the repository, of a folder its first page; else FileNotFoundError."""
    firsts = (file, f"{file}/README.md", f"{file}/index.md")
    file = next((each for each in firsts if (ROOT / each).is_file()), file)
    found = {source: place for place, source in PAGES.items()}
    if file in found:
        return found[file]
    if not (ROOT / file).is_file():
        raise FileNotFoundError(file)
    return file.removeprefix("docs/") if file.startswith("docs/") else f"files/{file}"


def targets(place: str, text: str) -> set[str]:
    """The files of the repository to which a page links."""
    folder = source_of(place).parent
    return {os.path.normpath(folder / link["path"]) for link in LINK.finditer(text)}


def on_files(files: Files, config: Any) -> Files:
    """Add the pages outside docs/, and all that pages link to."""
    places = [file.src_uri for file in files if file.is_documentation_page()] + [*PAGES]
    texts = {place: (ROOT / source_of(place)).read_text() for place in places}
    for place, source in PAGES.items():
        files.append(File.generated(config, place, content=(ROOT / source).read_text()))
    for file in sorted({file for place, text in texts.items() for file in targets(place, text)}):
        place = place_of(file)
        if place.startswith("files/") and files.get_file_from_path(place) is None:
            files.append(File.generated(config, place, content=(ROOT / file).read_bytes()))
    return files


def moved(link: re.Match[str], place: str) -> str:
    """A link of the repository as one of the site."""
    target = place_of(os.path.normpath(source_of(place).parent / link["path"]))
    return f"]({os.path.relpath(target, os.path.dirname(place) or '.')}{link['tail'] or ''})"


def drawn(found: re.Match[str]) -> str:
    """A formula as MathML; code as it is."""
    if found["code"]:
        return found["code"]
    if block := found["block"] or found["line"]:
        return f"\n<div>{convert(block.strip(), display='block')}</div>\n"
    return convert(found["quoted"] or found["plain"])


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The page as the site shows it."""
    place = page.file.src_uri
    parts = re.split(rf"({CODE.replace('(?!math)', '')})", markdown, flags=re.MULTILINE)
    for k in range(0, len(parts), 2):  # between pieces of code, and formulas
        text = re.sub(r"<!-- .*?-->\n?", "", parts[k], flags=re.DOTALL)
        parts[k] = LINK.sub(lambda link: moved(link, place), text)
    return MATH.sub(drawn, "".join(parts))
