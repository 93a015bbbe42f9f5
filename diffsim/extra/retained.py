"""Retained: how much of its return a policy keeps with finer substeps, and with contacts as in the file."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from diffsim.training.directory import say
from diffsim.training.evaluation import Evaluation
from diffsim.training.flags import Args

FINER = 4  # a return counts only if it survives this many times the substeps, without --implicit
ENOUGH = 0.97  # share of the return that must survive


def kept(own: float, finer: float) -> float:
    """Share of its own return that a policy keeps with finer substeps; of costs, returns below 0, the inverse ratio."""
    if own > 0:
        return finer / own
    return own / finer if finer < 0 else 1.0


def compare(args: Args, evaluation: Evaluation, measure: Callable[..., Evaluation]) -> dict[str, Any]:
    """Print how much of its return a policy keeps at FINER times the substeps, without --implicit.

    One that keeps less than ENOUGH has learned to exploit the integrator's errors. After training with --onset, print
    also how much of the return with that onset is left on the file's own contact, on which policies are evaluated.

    Args:
        measure: evaluates the policy with other arguments, and options of diffsim.make.

    Returns:
        for evaluation.json: the finer substeps, or the onset, with the return there and the share that is kept.
    """
    if not evaluation.compared:
        return {}
    own, substeps = evaluation.returns.median().item(), FINER * args.substeps
    value = measure(dataclasses.replace(args, substeps=substeps, implicit=False)).returns.median().item()
    share = kept(own, value)
    say(f"{substeps} substeps: return median {value:.1f}, {share:.1%} retained{_warning(share, 'more substeps')}")
    found = {"finer": {"substeps": substeps, "return": value, "kept": share}}
    if args.onset:
        value = measure(args, onset=args.onset).returns.median().item()
        share, onset = kept(value, own), f"the training's onset of {args.onset:g} m"
        say(f"{onset}: return median {value:.1f}, {share:.1%} retained without{_warning(share, 'a smaller --onset')}")
        found["onset"] = {"metres": args.onset, "return": value, "kept": share}
    return found


def _warning(share: float, remedy: str) -> str:
    return "" if share >= ENOUGH else f"; less than {ENOUGH:.0%}: train with {remedy}"
