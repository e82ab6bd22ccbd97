"""What ``import sb3_mpc_policy`` changes in Stable-Baselines3: one alias, and one callback for runs with this policy.

A run with any other policy takes the very same path through the library as without the import.
"""

from __future__ import annotations

from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_mpc_policy.callback import PredictionLossCallback
from sb3_mpc_policy.policies import MpcLcsPolicy

__all__ = ["ALIAS", "register"]

ALIAS = "MpcLcsPolicy"


def register() -> None:
    """Make ``"MpcLcsPolicy"`` known to PPO and A2C, and its transitions recorded in their runs. Idempotent."""
    for algorithm in (PPO, A2C):
        algorithm.policy_aliases[ALIAS] = MpcLcsPolicy
        if "_init_callback" not in vars(algorithm):
            algorithm._init_callback = _init_callback  # type: ignore[assignment, method-assign]


def _init_callback(self: OnPolicyAlgorithm, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
    """Stock ``_init_callback``, with a :class:`PredictionLossCallback` in front where the policy needs one."""
    if isinstance(self.policy, MpcLcsPolicy):
        children = callback if isinstance(callback, list) else [callback]
        converted = [
            child if isinstance(child, BaseCallback) else ConvertCallback(child)
            for child in children
            if child is not None
        ]
        if not any(_contains_hook(child) for child in converted):
            callback = [PredictionLossCallback(), *converted]
    return OnPolicyAlgorithm._init_callback(self, callback, progress_bar)


def _contains_hook(callback: BaseCallback) -> bool:
    if isinstance(callback, CallbackList):
        return any(_contains_hook(child) for child in callback.callbacks)
    # one inside an EventCallback does not count, as it is not told of rollouts and records nothing
    return isinstance(callback, PredictionLossCallback)
