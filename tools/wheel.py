"""What setuptools runs to build the wheel, which holds the scripts of the repository, too, as diffsim/learners."""

from __future__ import annotations

from pathlib import Path

from setuptools.command.build_py import build_py


class BuildPy(build_py):
    def run(self) -> None:
        super().run()
        if self.editable_mode:  # the clone itself has them
            return
        folder = Path(self.build_lib) / "diffsim" / "learners"
        self.mkpath(str(folder))
        for script in Path(__file__).resolve().parents[1].glob("*.py"):
            self.copy_file(str(script), str(folder))
