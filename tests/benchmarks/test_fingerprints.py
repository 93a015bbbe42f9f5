"""Fingerprints notice changed numbers and no changed words; the chain of them says which results count."""

from __future__ import annotations

import shutil
import subprocess

import common
import fingerprints
import paper
import pytest
from fingerprints import CASES, counts
from learners import refusal

from diffsim.training.errors import UsageError

NAMES = [*CASES]


@pytest.fixture
def chain(monkeypatch):
    """Links a-b-c-d, all equal; what trainings depend on is another in each revision but the equal pairs given."""

    def make(**equal: str) -> list[dict[str, str]]:
        made = [link("a", "b"), link("b", "c"), link("c", "d")]
        monkeypatch.setattr(fingerprints, "links", lambda: made)
        monkeypatch.setattr(fingerprints, "same_files", lambda a, b, _="": equal.get(a, a) == equal.get(b, b))
        return made

    return make


def link(parent: str, revision: str, differ: str = "", reason: str = "") -> dict[str, str]:
    equal = " ".join(name for name in NAMES if name not in differ.split())
    values = revision, parent, "cpu", equal, differ, reason
    return dict(zip(fingerprints.COLUMNS, values, strict=True))


def test_a_training_depends_on_its_learner_its_task_and_its_flags():
    for command, names in {
        "shac --env hopper": {"shac"},
        "shac --env ant": {"shac", "ant"},
        "sapo --env humanoid_mtu": {"sapo", "humanoid_mtu", "sapo_humanoid_mtu"},
        "ppo_baseline --contact mujoco --env go2": {"ppo_baseline", "mujoco", "joystick"},
        "shac --accuracy fast --env cartpole": {"shac", "cartpole", "fast"},
    }.items():
        assert fingerprints.depends(command) == names
    for cell in paper.wanted(paper.Args()):  # none is without a fingerprint of its learner and of its task
        script, *_ = paper.LEARNERS[cell.learner].split()
        names = fingerprints.depends(f"{paper.LEARNERS[cell.learner]} --env {cell.task}")
        assert script in names and (cell.task == "hopper" or cell.task in names)


def test_a_result_counts_while_each_link_keeps_what_it_depends_on(chain):
    made = chain(x="b", HEAD="d")
    assert all(counts(revision, "shac --env ant") for revision in "abcdx") and not counts("y", "shac --env ant")
    assert not fingerprints.open_end()
    made[1] = link("b", "c", differ="ant")
    assert [counts(revision, "shac --env ant") for revision in "abxcd"] == [False, False, False, True, True]
    assert counts("a", "shac --env humanoid")
    made[1] = link("b", "c") | {"equal": "shac"}  # the ant was not compared
    assert not counts("a", "shac --env ant") and counts("a", "shac --env hopper")
    made[1] = link("z", "c")  # nobody has compared b with z
    assert [counts(revision, "shac --env ant") for revision in "abzcd"] == [False, False, True, True, True]


def test_a_result_counts_while_its_preset_is_the_same(chain, monkeypatch):
    chain()
    text = "class Ant:\n    fast = Integration({})\n"
    files = {
        f"{at}:diffsim/tasks/ant.py": text.format(n)
        for at, n in (("a", "8"), ("b", '"implicit", 8'), ("HEAD", '"soft", 8, implicit=True'))
    }

    def show(call: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(call, 0, files.get(call[-1], ""))

    monkeypatch.setattr(subprocess, "run", show)
    fingerprints.preset.cache_clear()
    for flags, kept in (("--accuracy fast", False), ("", True)):
        assert counts("a", f"shac {flags} --env ant") == kept and counts("b", f"shac {flags} --env ant")
    fingerprints.preset.cache_clear()


def test_head_is_the_newest_revision_or_the_command_is_told(chain):
    made = chain()
    told = fingerprints.open_end()
    assert "changed since d" in told and told.endswith(": python benchmarks/paper.py --same d --update-results")
    assert told in paper.check(paper.Args(only=("alpha",)))
    made.clear()
    assert not counts("d", "shac --env ant") and "no revision is recorded" in fingerprints.open_end()
    assert "6 of 6 cells are missing" in paper.check(paper.Args(only=("alpha",)))


def test_the_chain_of_the_results_is_whole():
    links = fingerprints.links()
    assert links, "no result counts"
    if not fingerprints.same_files(links[0]["parent"], links[0]["parent"]):
        pytest.skip("the history is not here")
    for older, newer in zip(links, links[1:], strict=False):
        assert fingerprints.same_files(older["revision"], newer["parent"])
    for each in links:
        assert fingerprints.same_files(each["revision"], each["revision"]) and each["machine"]
        assert not each["differ"] or each["reason"]


def test_a_link_is_recorded_where_the_chain_ends_and_with_its_reason(chain, monkeypatch, capsys):
    chain()
    args, found = paper.Args(update_results=True, device="cpu"), dict.fromkeys(CASES, True)
    written = list[dict[str, str]]()
    monkeypatch.setattr(fingerprints, "compare", lambda *_: found)
    monkeypatch.setattr(fingerprints, "checked_out", lambda revision: fingerprints.TemporaryDirectory())
    monkeypatch.setattr("tables.replace_csv", lambda path, rows, *_: written.extend(rows))
    assert "the chain ends at d: --same d" in refusal(lambda: fingerprints.record(args, "b", ""), capsys)
    fingerprints.record(args, "d", "")
    assert written[-1]["equal"].split() == NAMES and (written[-1]["parent"], written[-1]["differ"]) == ("d", "")
    found["ant"] = False
    with pytest.raises(UsageError, match="says why"):
        fingerprints.record(args, "d", "")
    assert len(written) == 1
    fingerprints.record(args, "d", "a better ant")
    assert (written[-1]["differ"], written[-1]["reason"]) == ("ant", "a better ant")


def test_fingerprints_notice_changed_numbers_and_no_changed_words(tmp_path):
    """Of the task and of a kernel; each copy of the package is trained on its own."""
    ignored = shutil.ignore_patterns("__pycache__", "policies")
    shutil.copytree(common.ROOT / "diffsim", tmp_path / "diffsim", ignore=ignored)
    shutil.copy(common.ROOT / "shac.py", tmp_path)

    def changed(name: str, old: str, new: str) -> str:
        path = tmp_path / "diffsim" / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        found = fingerprints.fingerprint(tmp_path, "cartpole")
        path.write_text(text)
        return found

    before = fingerprints.fingerprint(common.ROOT, "cartpole")
    assert before and changed("tasks/cartpole.py", "Eq. 13:", "Equation 13 says:") == before
    assert changed("tasks/cartpole.py", "0.1", "0.11") not in (before, "")
    assert changed("kernels/thread/spatial.py", "p = mass * ", "p = T(1.01) * mass * ") not in (before, "")
    assert changed("tasks/cartpole.py", "import", "imports") == ""
