"""python -m diffsim: the commands of extra/commands.py."""

from __future__ import annotations

import pkgutil

if __name__ == "__main__":
    pkgutil.resolve_name("diffsim.extra.commands:main")()
