"""Write docs/api.md, the public names of diffsim, from their signatures and docstrings: python tools/api.py"""

from __future__ import annotations

import inspect
import pkgutil
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import diffsim

PAGE = Path(__file__).resolve().parents[1] / "docs" / "api.md"
HEAD = """# API

Signatures with defaults, shapes, units, errors and an example of each public name. `python tools/api.py` writes this
page from the code. N is the number of environments. `SceneError` and `TaskError` are `ValueError`s.
"""
NAMES = (
    *(f"diffsim:{name}" for name in "make DiffEnv Task Task.load_robot load_scene".split()),
    "diffsim.robot.pairs:with_pairs",
    *(f"diffsim:{name}" for name in "Simulator Integration".split()),
    "diffsim.sim.options:Options",
    "diffsim.parameters:ParametricSimulator",
    "diffsim.training:load_policy",
    "diffsim_robots.terrain:rough",
)
FULL = "step reset detach set_state jacobians adjustable elements".split()  # methods printed with all they say
# Methods that few programs need
INTERNAL = """pin_rollout write_back take_statistics advance check_tensor tangent check load_robot scene bind presets
integration falls has_mirror configured terrain stored restored over ghost disturb observe_with restore""".split()
SIDE = 100  # characters of a signature's line
EXAMPLE = re.compile(r"Example:\n((?:\n|    .*(?:\n|\Z))+)")


def signature(thing: object) -> str:
    """The parameters without annotations and self, in lines of at most SIDE characters."""
    lines = [""]
    for each in inspect.signature(thing).parameters.values():  # type: ignore[arg-type]
        if each.name not in ("self", "cls", "unknown"):
            star = "*" * (each.kind == each.VAR_POSITIONAL) + "**" * (each.kind == each.VAR_KEYWORD)
            word = f"{star}{each.name}" + ("" if each.default is each.empty else f"={each.default!r}")
            joined = f"{lines[-1]}, {word}".removeprefix(", ")
            lines = [*lines, word] if len(joined) > SIDE else [*lines[:-1], joined]
    return ",\n    ".join(lines)


def called(name: str, thing: object) -> str:
    """How a function or a class is called, as a block of text."""
    return f"```text\n{name}({signature(thing)})\n```\n"


def told(thing: object) -> Iterator[str]:
    """The docstring as text, and its example, which tests run, as Python."""
    doc = inspect.getdoc(thing) or ""
    text = re.sub(r"\n{3,}", "\n\n", EXAMPLE.sub("", doc)).strip()
    yield f"```text\n{text}\n```\n"
    for example in EXAMPLE.findall(doc):
        yield f"```python\n{textwrap.dedent(example).strip()}\n```\n"


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


def entry(path: str) -> Iterator[str]:
    """The parts of the page about one name."""
    module, _, name = path.partition(":")
    thing: Any = pkgutil.resolve_name(path)
    yield f"## {name}\n"
    yield called(f"{module}.{name}", thing)
    yield from told(thing)
    if isinstance(thing, type):
        for method in full(thing):
            each = getattr(thing, method)
            yield f"### {name}.{method}\n"
            yield called(f"{name}.{method}", each)
            yield from told(each)
        if isinstance(parameters := vars(thing).get("parameters"), property):
            yield f"### {name}.parameters\n"
            yield from told(parameters)
        if (rows := [*members(thing)]) and not issubclass(thing, tuple):
            yield "\n".join(["| member | meaning |", "|---|---|", *rows]) + "\n"


def page() -> str:
    """The text of the page."""
    return "\n".join([HEAD, *(part for path in NAMES for part in entry(path))])


if __name__ == "__main__":
    PAGE.write_text(page())
