"""Model-predictive control over a learned contact model, as a policy for Stable-Baselines3.

Importing this package makes ``PPO("MpcLcsPolicy", env)`` work and registers the environments of ``contact_envs``.
"""

from __future__ import annotations

import contact_envs  # noqa: F401  (registers the environments)
from sb3_mpc_policy.callback import PredictionLossCallback
from sb3_mpc_policy.hyperparameters import hyperparams
from sb3_mpc_policy.lcs import LcsMatrices, LinearComplementaritySystem
from sb3_mpc_policy.mpc import LcsMpc, MpcPlan
from sb3_mpc_policy.policies import MpcLcsPolicy
from sb3_mpc_policy.registration import register
from sb3_mpc_policy.reward import QuadraticReward

__all__ = [
    "LcsMatrices",
    "LcsMpc",
    "LinearComplementaritySystem",
    "MpcLcsPolicy",
    "MpcPlan",
    "PredictionLossCallback",
    "QuadraticReward",
    "hyperparams",
]
__version__ = "0.1.0"

register()
