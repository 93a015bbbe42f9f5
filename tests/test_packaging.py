"""What a wheel, a source distribution and an editable install hold, and that the package is found in each folder."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import pkgutil
import re
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path
from zipfile import ZipFile

import pytest
from learners import PATH

import diffsim
from diffsim_cli.commands import find_learners

pytest.importorskip("hatchling")

ROOT = Path(__file__).resolve().parents[1]
BUILD = "from hatchling.build import build_{0}; build_{0}('dist')"  # as pip does, without its isolation


@pytest.fixture(scope="module")
def repository() -> list[str]:
    """The files that belong to it; an environment in the clone's folder does not."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("what belongs to the repository, git alone knows")
    environments = {path.parent.name for path in ROOT.glob("*/pyvenv.cfg")}
    return sorted(name for name in listed if name.split("/")[0] not in environments and (ROOT / name).is_file())


@pytest.fixture(scope="module")
def source(repository: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, in which a build may leave what it likes."""
    copy = tmp_path_factory.mktemp("clones") / "diffsim"
    for name in repository:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy / name)
    return copy


def build(kind: str, source: Path) -> Path:
    shutil.rmtree(source / "dist", ignore_errors=True)
    subprocess.run([sys.executable, "-c", BUILD.format(kind)], cwd=source, capture_output=True, check=True)
    (path,) = (source / "dist").glob("*.tar.gz" if kind == "sdist" else "*.whl")
    return path


def test_the_wheel_holds_the_package_and_the_licenses(repository: list[str], source: Path) -> None:
    with ZipFile(build("wheel", source)) as wheel:
        names = set(wheel.namelist())
    package = {name for name in repository if name.startswith(("diffsim/", "diffsim_robots/", "diffsim_cli/"))}
    scripts = {name for name in repository if re.fullmatch(r"(baselines/)?\w+\.py", name)}
    assert {str(path.relative_to(ROOT)) for path in find_learners().values()} == scripts
    package |= {f"diffsim_cli/learners/{name}" for name in scripts}
    assert {name for name in names if ".dist-info/" not in name} == package
    needed = "py.typed", "assets/NOTICE", "policies/ant.pt", "policies/cards.csv"
    assert {f"diffsim/{name}" for name in needed} <= names
    licenses = {name.partition(".dist-info/licenses/")[2] for name in names} - {""}
    assert licenses == {"LICENSE", "NOTICE", *(f"licenses/{path.name}" for path in (ROOT / "licenses").iterdir())}


def test_the_source_distribution_holds_the_repository(repository: list[str], source: Path) -> None:
    with tarfile.open(build("sdist", source)) as archive:
        files = {member.name.partition("/")[2] for member in archive if member.isfile()}
    assert files - {"PKG-INFO"} == {*repository}


def test_what_names_a_version_names_todays() -> None:
    version = diffsim.__version__
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"version = {{{version}}}" in (ROOT / "README.md").read_text()
    assert f"diffsim_rl-{version}-py3-none-any.whl" in (ROOT / "examples" / "first_steps.ipynb").read_text()


def test_an_editable_install_is_found_from_every_folder(source: Path, tmp_path: Path) -> None:
    """From the clone's parent, too, where the clone's own folder has the name of the package."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path)], check=True)
    with ZipFile(build("editable", source)) as wheel:
        wheel.extractall(next((tmp_path / "lib").glob("python*/site-packages")))
    program = "from importlib.util import find_spec; print(find_spec('diffsim').origin)"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for folder in (source, source.parent, tmp_path):
        command = [str(tmp_path / "bin" / "python"), "-c", program]
        found = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout
        assert Path(found.strip()) == source / "diffsim" / "__init__.py"


def test_every_part_can_be_imported_by_its_name() -> None:
    """No name of the package's front hides a subpackage."""
    import diffsim.robot.scene as scene

    assert scene.Scene is diffsim.Scene and diffsim.robot.scene is scene
    for part in ("kernels", "learning", "planning", "robot", "sim", "symmetry", "tasks", "training"):
        assert importlib.import_module(f"diffsim.{part}") is getattr(diffsim, part)


def test_no_script_imports_another() -> None:
    scripts = {name: ast.walk(ast.parse(path.read_text())) for name, path in find_learners().items()}
    for name, nodes in scripts.items():
        for node in nodes:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not scripts.keys() & {part.partition(".")[0] for part in names}, name


FLOORS = {"kernels": "robot", "sim": "kernels", "tasks": "sim", "env": "tasks", "training": "env"}  # by what lies below


def below(part: str) -> set[str]:
    return {FLOORS[part]} | below(FLOORS[part]) if part in FLOORS else set()


def core() -> dict[str, ast.Module]:
    """The modules of the package, by their names."""
    package = Path(diffsim.__file__).parent
    paths = (path.relative_to(package.parent).with_suffix("") for path in package.rglob("*.py"))
    names = [".".join(path.parts).removesuffix(".__init__") for path in paths]
    files = {name: importlib.util.find_spec(name) for name in names}
    return {name: ast.parse(Path(str(spec.origin)).read_text()) for name, spec in files.items() if spec}


def imports(name: str, tree: ast.Module) -> Iterator[str]:
    """The modules that a module imports anywhere in its source; of "from a import b" both a and a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{name} has a relative import"
            yield str(node.module)
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_package_imports_neither_robots_nor_commands() -> None:
    """Neither in a function nor for types. What it uses of them it names in a string."""
    named = set()
    for name, tree in core().items():
        found = [each for each in imports(name, tree) if re.match(r"diffsim_(robots|cli)(\.|$)", each)]
        assert not found, f"{name} imports {found[0]}"
        texts = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
        named |= {text for text in texts if isinstance(text, str) and re.fullmatch(r"diffsim\w*(\.\w+)*:\w+", text)}
    assert all(any(text.startswith(f"diffsim_{name}.") for text in named) for name in ("robots", "cli"))
    for text in named:
        assert callable(pkgutil.resolve_name(text)), text


def test_imports_go_down_the_drawing() -> None:
    """CONTRIBUTING.md draws the floors of the core. A module imports its own floor and those below."""
    for name, tree in core().items():
        own = name.split(".")[1] if "." in name else ""
        for other in imports(name, tree):
            part = other.split(".")[1] if other.startswith("diffsim.") else ""
            if own in {*FLOORS, "robot"} and part in {*FLOORS, "robot"}:
                assert part == own or part in below(own), f"{name} imports {other}"


def test_importing_the_package_loads_neither() -> None:
    modules = "diffsim, diffsim.tasks, diffsim.env"
    program = f"import sys, {modules}; print([name for name in sys.modules if name.startswith('diffsim_')])"
    command = [sys.executable, "-c", program]
    found = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | PATH).stdout
    assert found.strip() == "[]"
