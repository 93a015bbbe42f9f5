"""Planning: a robot as a discrete-time system, iterative LQR, and linear-Gaussian controllers.

The physics knows nothing of this package, and it knows nothing of training.
"""

from __future__ import annotations

from diffsim.extra.planning.controller import LinearGaussian, gaussian_log_prob, maximum_entropy_controllers
from diffsim.extra.planning.cost import AfterStep, Sum, Surprisal, Tracking
from diffsim.extra.planning.demonstration import follow_demonstration, load_demonstration, save_demonstration
from diffsim.extra.planning.ilqr import Cost, Plan, backward_pass, follow, ilqr, step_jacobian
from diffsim.extra.planning.samples import Samples, SampleSet
from diffsim.extra.planning.system import REAL, System
