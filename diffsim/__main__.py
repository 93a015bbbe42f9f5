"""python -m diffsim: the commands of diffsim_cli/commands.py."""

from __future__ import annotations

import pkgutil

if __name__ == "__main__":
    pkgutil.resolve_name("diffsim_cli.commands:main")()
