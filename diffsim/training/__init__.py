"""What surrounds every learner and is part of no algorithm: flags, runs, checkpoints, logs, evaluation, CUDA graphs.

The physics knows nothing of this package.
"""

from __future__ import annotations

from diffsim.training import distributed
from diffsim.training.assess import evaluate_checkpoint, make_policy_env
from diffsim.training.checkpoint import Learner, SavedPolicy, export_policy, load_policy
from diffsim.training.ensemble import Ensemble, EnsembleAdam
from diffsim.training.errors import UsageError, command, fail
from diffsim.training.evaluation import Evaluation, evaluate
from diffsim.training.flags import Flags, ParallelFlags, parse, parse_penalty
from diffsim.training.likeliest import Likeliest
from diffsim.training.normalizer import ObsNormalizer, moments
from diffsim.training.optimizer import ClippedAdam
from diffsim.training.ranges import (
    Count,
    Decay,
    Finite,
    Fraction,
    Natural,
    NonNegative,
    Positive,
    Repeats,
    SomeWidths,
    Widths,
)
from diffsim.training.replay import ReplayBuffer, Transition
from diffsim.training.run import Run
from diffsim.view.gait import Gait, describe

__all__ = [
    "ClippedAdam",
    "Count",
    "Decay",
    "Ensemble",
    "EnsembleAdam",
    "Evaluation",
    "Finite",
    "Flags",
    "Fraction",
    "Gait",
    "Learner",
    "Likeliest",
    "Natural",
    "NonNegative",
    "ObsNormalizer",
    "ParallelFlags",
    "Positive",
    "Repeats",
    "ReplayBuffer",
    "Run",
    "SavedPolicy",
    "SomeWidths",
    "Transition",
    "UsageError",
    "Widths",
    "command",
    "describe",
    "distributed",
    "evaluate",
    "evaluate_checkpoint",
    "export_policy",
    "fail",
    "load_policy",
    "make_policy_env",
    "moments",
    "parse",
    "parse_penalty",
]
