"""Write docs/api.md, the public names of diffsim, from their docstrings: python tools/api.py"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import diffsim

PAGE = Path(__file__).resolve().parents[1] / "docs" / "api.md"
HEAD = """# API

`python tools/api.py` writes this page from docstrings; `help` prints all of them. N is the number of environments.
`SceneError` and `TaskError` are `ValueError`s.
"""
NAMES = "make DiffEnv Simulator Task".split()
FULL = "step reset detach set_state jacobians".split()  # methods of DiffEnv and Simulator, printed with all they say
# Methods that few programs need
INTERNAL = """pin_rollout write_back take_statistics advance check_tensor tangent check load_robot scene bind presets
integration falls has_mirror configured terrain stored restored over ghost disturb observe_with""".split()


def signature(thing: object) -> str:
    """The parameters without annotations and self, in lines of at most 100 characters."""
    lines = [""]
    for each in inspect.signature(thing).parameters.values():  # type: ignore[arg-type]
        if each.name not in ("self", "cls", "unknown"):
            star = "*" * (each.kind == each.VAR_POSITIONAL) + "**" * (each.kind == each.VAR_KEYWORD)
            word = f"{star}{each.name}" + ("" if each.default is each.empty else f"={each.default!r}")
            joined = f"{lines[-1]}, {word}".removeprefix(", ")
            lines = [*lines, word] if len(joined) > 100 else [*lines[:-1], joined]
    return ",\n    ".join(lines)


def members(kind: type) -> Iterator[str]:
    """A row for each other public method that the class documents: its first sentence."""
    for name, each in vars(kind).items():
        doc = each.__doc__ if inspect.isfunction(each) else None
        if doc and not name.startswith("_") and name not in INTERNAL and name not in full(kind):
            call = re.sub(r"\s+", " ", f"({signature(each)})")
            first = re.split(r"(?<=[.;]) |(?<=[\w)]): ", " ".join(doc.split()))[0]
            yield f"| `{name}{call}` | {first.rstrip(';')} |"


def full(kind: type) -> list[str]:
    """The names of the class's methods that the page prints with all that they say."""
    return [name for name in FULL if name in vars(kind)] if kind is not diffsim.Task else []


def page() -> str:
    """The text of the page. Classes have what help shows before and after their arguments."""
    parts = [HEAD]
    for name in NAMES:
        thing, kind = getattr(diffsim, name), isinstance(getattr(diffsim, name), type)
        doc = re.sub(r"\n\nExample:\n.*?(?=\n\n\w)", "", inspect.getdoc(thing) or "", flags=re.DOTALL)
        doc = re.sub(r"\n\n(Args|Raises):\n.*?(?=\n\n\w|\Z)", "", doc, flags=re.DOTALL) if kind else doc
        parts.append(f"## {name}\n\n```python\ndiffsim.{name}\n```\n\n```text\n{doc}\n```\n")
        for method in full(thing) if isinstance(thing, type) else ():
            each = getattr(thing, method)
            parts.append(f"### {name}.{method}({signature(each)})\n\n```text\n{inspect.getdoc(each)}\n```\n")
        if kind and (rows := [*members(thing)]):
            parts.append("\n".join(["| member | meaning |", "|---|---|", *rows]) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page())
