"""What surrounds every learner and is part of no algorithm: flags, runs, checkpoints, logs, evaluation, CUDA graphs.

The physics knows nothing of this package.
"""

from __future__ import annotations

from diffsim.training.checkpoint import Learner, SavedPolicy, load_policy
from diffsim.training.errors import UsageError, fail
from diffsim.training.evaluation import Evaluation, evaluate, evaluate_checkpoint
from diffsim.training.flags import parse
from diffsim.training.layers import ObsNormalizer
from diffsim.training.main import command, script
from diffsim.training.optimizer import ClippedAdam
from diffsim.training.ranges import Count, Natural, NonNegative, Positive
from diffsim.training.run import Run
