"""benchmarks/gps_variants.py: what each variant of Figure 2 does otherwise."""

from __future__ import annotations

from pathlib import Path

import gps_variants
import pytest
import torch
from learners import assert_same, run

import diffsim
import gps

TINY = (
    "--env cartpole --horizon 8 --restarts 3 --screening 4 --ilqr-iterations 3 --pretraining 5 --hidden 8 "
    "--guiding-samples 8 --samples 4 --active 16 --stored 24 --iterations 2 --lbfgs-iterations 5 --eval-episodes 1 "
    "--quiet"
).split()


@pytest.mark.parametrize("case", list(gps_variants.CASES))
def test_variants(case: str, tmp_path: Path) -> None:
    modules = run(gps_variants, tmp_path, *TINY, "--case", case)["modules"]
    search, S, guided = modules["learner"], modules["S"], case in ("unregularized", "effective", "one-start")
    assert any(len(generator) > 1 for generator in S["generators"]) == guided == (S["initial"] == 1)
    assert (search["w_r"] == 0) == (case == "unregularized")
    assert (len(S["samples"][0][:, 0].unique(dim=0)) > 3) == (case == "restart")
    assert len(search["lessons"]) == {"dagger": 2}.get(case, 0)
    assert case != "dagger" or len(search["lessons"][0]) == 8 + 2 * 4
    moved = not torch.equal(modules["network"]["theta"], S["generators"][S["best"]][0])
    assert moved == (case in ("policy-gradient", "dagger"))


def test_a_bound_on_effective_samples(tmp_path: Path) -> None:
    """The proposal keeps it at every step, where that of the search without the regulariser does not."""
    least = []
    for case in ("unregularized", "effective"):
        flags = [*TINY, "--case", case, *"--lbfgs-iterations 40 --pretraining 40 --noise 0.3 --device cpu".split()]
        args = gps_variants.parse(gps_variants.VariantArgs, flags)
        search = gps_variants.CASES[args.case](args, diffsim.make("cartpole", 1))
        search.prepare(lambda _: None, tmp_path / f"{case}.npz")
        S = search.S.samples
        log_pi = search.network.log_prob(search.optimise(S)[0], S.obs, S.u)
        least.append((1 / gps.log_weights(log_pi, S.log_mixture).softmax(0).square().sum(0)).min().item())
    assert least[0] < 4.0 < 4.9 < least[1]


def test_one_start(tmp_path: Path) -> None:
    """It proposes what the search does where the start at theta* wins; otherwise Phi is lower."""
    args = gps_variants.parse(gps_variants.VariantArgs, [*TINY, "--case", "one-start", "--device", "cpu"])
    search = gps_variants.OneStart(args, diffsim.make("cartpole", 1))
    search.prepare(lambda _: None, tmp_path / "plan.npz")
    one, alone = search.optimise(search.S.samples)
    both, two = gps_variants.gps.Search.optimise(search, search.S.samples)
    assert "gps/start" not in alone and torch.equal(one, both) == (two["gps/start"] == 0)
    assert alone["gps/phi"] == two["gps/phi"] if two["gps/start"] == 0 else alone["gps/phi"] < two["gps/phi"]


def test_resume(tmp_path: Path) -> None:
    """The checkpoint says which variant it is of."""
    whole = run(gps_variants, tmp_path / "whole", *TINY, "--case", "restart")
    run(gps_variants, tmp_path / "parts", *TINY, "--case", "restart", "--stop-after", "1")
    gps_variants.main(["--resume", str(tmp_path / "parts" / "checkpoint.pt")])
    parts = torch.load(tmp_path / "parts" / "checkpoint.pt", weights_only=True)
    assert_same(parts["modules"], whole["modules"])
