"""The wheel holds all of the package and nothing else; the source distribution holds the repository."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from zipfile import ZipFile

import pytest

from diffsim.__main__ import LEARNERS

pytest.importorskip("setuptools", minversion="77", reason="pyproject's license needs setuptools 77")

ROOT = Path(__file__).resolve().parents[1]
BUILD = "from setuptools.build_meta import build_{0}; build_{0}('dist')"  # as pip does, without its isolation


@pytest.fixture(scope="module")
def repository() -> list[str]:
    """The files that belong to it."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("what belongs to the repository, git alone knows")
    return sorted(name for name in listed if (ROOT / name).is_file())


@pytest.fixture(scope="module")
def source(repository: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, in which a build may leave what it likes."""
    copy = tmp_path_factory.mktemp("source")
    for name in repository:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy / name)
    return copy


def build(kind: str, source: Path) -> Path:
    subprocess.run([sys.executable, "-c", BUILD.format(kind)], cwd=source, capture_output=True, check=True)
    (path,) = (source / "dist").glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return path


def test_the_wheel_holds_the_package_and_the_licenses(repository: list[str], source: Path) -> None:
    with ZipFile(build("wheel", source)) as wheel:
        names = set(wheel.namelist())
    package = {name for name in repository if name.startswith("diffsim/")}
    scripts = {name for name in repository if name.endswith(".py") and "/" not in name}
    assert {f"{name}.py" for name in LEARNERS} | {"view.py"} == scripts
    package |= {f"diffsim/learners/{name}" for name in scripts}
    assert {name for name in names if ".dist-info/" not in name} == package
    needed = "py.typed", "assets/web.html", "assets/NOTICE", "policies/ant.pt", "policies/cards.csv"
    assert {f"diffsim/{name}" for name in needed} <= names
    licenses = {name.partition(".dist-info/licenses/")[2] for name in names} - {""}
    assert licenses == {"LICENSE", "NOTICE", *(f"licenses/{path.name}" for path in (ROOT / "licenses").iterdir())}


def test_the_source_distribution_holds_the_repository(repository: list[str], source: Path) -> None:
    with tarfile.open(build("sdist", source)) as archive:
        files = {member.name.partition("/")[2] for member in archive if member.isfile()}
    extra = {name for name in files if name in ("PKG-INFO", "setup.cfg") or ".egg-info/" in name}
    assert files - extra == {*repository}
