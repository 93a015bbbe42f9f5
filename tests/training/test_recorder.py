"""What a run records: taken without waiting for the device, written when the device has done its work."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from diffsim.training import clock
from diffsim.training.clock import Clock
from diffsim.training.recorder import WRITE_EVERY, EpisodeStatistics, Recorder
from diffsim.training.signals import Signals

CPU = torch.device("cpu")


class Log:
    """Keeps the rows that it is given."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, float, Mapping[str, float]]] = []

    def write(self, *row: Any) -> None:
        self.rows.append(row)


class Episodes:
    """An environment whose statistics are given."""

    def __init__(self, **values: float) -> None:
        self.values = dict.fromkeys(("episodes", "return", "length", "nonfinite", "nonfinite_gradients"), 0.0) | values

    def take_statistics(self) -> dict[str, torch.Tensor]:
        return {name: torch.tensor(value) for name, value in self.values.items()}


def recorder(device: str = "cpu") -> tuple[Recorder, Any]:
    found, log = Recorder(torch.device(device), Signals(), quiet=True), Log()
    found.log = log  # type: ignore[assignment]
    return found, log


@pytest.fixture
def moments(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The host's clock, which only moves when it is told to."""
    now = SimpleNamespace(time=100.0)
    monkeypatch.setattr(clock.time, "perf_counter", lambda: now.time)
    return now


def test_what_is_taken_is_written_later_with_its_totals(moments: SimpleNamespace) -> None:
    found, log = recorder()
    for k in (1, 2):
        moments.time += 0.5
        env: Any = Episodes(episodes=2.0 * k, **{"return": 30.0 * k, "length": 10.0}, nonfinite=k)
        found.take(k, 100, {"losses/a": torch.tensor(0.5 * k), "charts/b": k}, env)
    assert not log.rows and found.seconds == found.control_steps == 0 and found.is_full
    found.newest.scalars["eval/return"] = 7.0
    assert found.write() is False
    (first, second), shared = log.rows, {"sim/nonfinite_gradients": 0, "time/total": 0.5, "charts/SPS": 200.0}
    means = {"charts/episodic_return": 15.0, "charts/episodic_length": 5.0}
    assert first == (1, 100, 0.5, {"losses/a": 0.5, "charts/b": 1.0, "sim/nonfinite": 1} | shared | means)
    means = {"charts/episodic_return": 15.0, "charts/episodic_length": 20 / 6, "eval/return": 7.0}
    assert second == (2, 200, 1.0, {"losses/a": 1.0, "charts/b": 2.0, "sim/nonfinite": 3} | shared | means)
    assert found.scalars == second[-1]
    assert found.write() is False and len(log.rows) == 2

    other, _ = recorder()
    other.load_state_dict(found.state_dict())
    assert other.state_dict() == found.state_dict()
    assert (other.control_steps, other.seconds, other.totals["sim/nonfinite"]) == (200, 1.0, 3)


def test_a_record_tells_which_signals_had_arrived(moments: SimpleNamespace) -> None:
    found, _ = recorder()
    moments.time += 1.0
    found.take(1, 1, {}, None)
    found.signals.received.append(15)  # too late for this record
    assert found.write() is False
    moments.time += 1.0
    found.take(2, 1, {}, None)
    assert found.write() is True


def test_a_gpu_is_waited_for_once_in_some_iterations_or_if_someone_asks_to_stop() -> None:
    found, _ = recorder()
    found.clock.device = torch.device("meta")  # no CPU
    for k in range(1, WRITE_EVERY):
        found.take(k, 1, {}, None)
    assert not found.is_full
    found.signals.received.append(2)
    assert found.is_full
    found.signals.received.clear()
    found.take(WRITE_EVERY, 1, {}, None)
    assert found.is_full


def test_a_reward_that_is_not_finite_ends_the_writing() -> None:
    found, log = recorder()
    found.take(1, 1, {}, Episodes(**{"return": float("nan")}))  # type: ignore[arg-type]
    with pytest.raises(FloatingPointError, match="a reward is not finite"):
        found.write()
    assert not log.rows


def test_episode_statistics_are_of_the_newest_rollouts_with_a_hundred_episodes() -> None:
    statistics = EpisodeStatistics()
    statistics.add(0, 0.0, 0.0)
    assert not statistics.rollouts
    statistics.add(60, 600.0, 6000.0)
    assert statistics.means() == (10.0, 100.0)
    statistics.add(30, 600.0, 3000.0)
    assert statistics.means() == (1200 / 90, 100.0)
    statistics.add(70, 700.0, 700.0)  # with the second as many as a hundred: the first is forgotten
    assert statistics.means() == (1300 / 100, 3700 / 100)
    statistics.add(0, 0.0, 0.0)
    assert statistics.means() == (1300 / 100, 3700 / 100)
    statistics.add(500, 500.0, 500.0)
    assert statistics.means() == (1.0, 1.0)


# Time -----------------------------------------------------------------------------------------------------------------


def test_the_clock_times_an_iteration_and_its_parts(moments: SimpleNamespace) -> None:
    found = Clock(CPU)
    moments.time += 8.0  # before the iteration
    found.restart()
    with found.part("first"):
        moments.time += 1.0
    moments.time += 0.25
    with pytest.raises(ValueError), found.part("failed"):
        raise ValueError
    with found.part("second"):
        moments.time += 2.0
    spans = found.lap()
    times = {name: end.since(begin) for name, (begin, end) in spans.items()}
    assert times == {"time/first": 1.0, "time/second": 2.0, "time/total": 3.25}
    moments.time += 0.5
    ((begin, end),) = found.lap().values()
    assert end.since(begin) == 0.5


def test_on_a_gpu_the_devices_events_are_timed_and_nothing_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The host is far ahead of the device: its clock has nothing to say."""

    class Event:
        """Reached by the device at a time of its own."""

        device_time = 0.0  # ms

        def __init__(self, enable_timing: bool) -> None:
            assert enable_timing

        def record(self, stream: str) -> None:
            assert stream == "the stream of cuda:0"
            Event.device_time += 1500.0
            self.time = Event.device_time

        def elapsed_time(self, other: Event) -> float:
            return other.time - self.time

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: f"the stream of {device}")
    found = Clock(torch.device("cuda:0"))
    with found.part("update"):
        pass
    times = {name: end.since(begin) for name, (begin, end) in found.lap().items()}
    assert times == {"time/update": 1.5, "time/total": 4.5}
