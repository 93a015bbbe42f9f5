"""Planning: a robot as a discrete-time system, iterative LQR, and linear-Gaussian controllers.

The physics knows nothing of this package, and it knows nothing of training.
"""

from __future__ import annotations

from diffsim.planning.controller import LinearGaussian, gaussian_log_prob, maximum_entropy_controllers
from diffsim.planning.cost import AfterStep, Sum, Surprisal, Tracking
from diffsim.planning.demonstration import follow_demonstration, load_demonstration, save_demonstration
from diffsim.planning.ilqr import Cost, Plan, backward_pass, follow, ilqr, step_jacobian
from diffsim.planning.samples import Samples, SampleSet
from diffsim.planning.system import REAL, System
