"""The hook: true transitions out of stock ``collect_rollouts``, into the policy, before each stock ``train()``."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mpc_policy.policies import MpcLcsPolicy

__all__ = ["PredictionLossCallback"]


class PredictionLossCallback(BaseCallback):
    """Records what the environment really did and hands it to an :class:`MpcLcsPolicy`.

    ``import sb3_mpc_policy`` makes PPO and A2C attach one by themselves; passing one explicitly does not double it.

    The rollout buffer of Stable-Baselines3 cannot serve: it holds the unclipped action, no next observation, and after
    the end of an episode the observation of the next one.
    """

    def _on_training_start(self) -> None:
        policy = self.model.policy
        if not isinstance(policy, MpcLcsPolicy):
            raise TypeError(f"PredictionLossCallback is for MpcLcsPolicy, and this policy is a {type(policy).__name__}")
        self.policy = policy
        self._normalize = self.model.get_vec_normalize_env()
        check_observations(self._normalize)
        self._in_rollout = False

    def _on_rollout_start(self) -> None:
        """The update on the last rollout is over: fit the model to all that is known, then plan with it."""
        self._end_update()
        self.policy.store.start_rollout()
        self._in_rollout = True

    def _on_step(self) -> bool:
        if not self._in_rollout:  # inside an EventCallback, which passes on some steps and no rollouts
            return True
        infos, dones = self.locals["infos"], self.locals["dones"]
        # at this point of collect_rollouts _last_obs still is the observation the action was chosen for
        s_next = np.array(self.locals["new_obs"], dtype=np.float64)
        for i in np.flatnonzero(dones):
            # new_obs is where the next episode starts
            s_next[i] = infos[i]["terminal_observation"]
        reward = self.locals["rewards"]
        if self._normalize is not None and self._normalize.norm_reward:
            reward = self._normalize.get_original_reward()
        s = self.model._last_obs
        assert isinstance(s, np.ndarray)
        self.policy.store.add(s, self.locals["clipped_actions"], reward, s_next)
        return True

    def _on_rollout_end(self) -> None:
        self.policy.prepare_update()

    def _on_training_end(self) -> None:
        self._end_update()
        self.policy.end_training()

    def _end_update(self) -> None:
        reward_scale = 1.0
        if self._normalize is not None and self._normalize.norm_reward:
            reward_scale = float(np.sqrt(self._normalize.ret_rms.var + self._normalize.epsilon))
        for key, value in self.policy.end_update(reward_scale).items():
            self.logger.record(key, value)


def check_observations(normalize: VecNormalize | None) -> None:
    """
    :raise ValueError: where observations are normalised: the model's coordinates would move while it learns
    """
    if normalize is not None and normalize.norm_obs:
        raise ValueError(
            "VecNormalize(norm_obs=True) moves the coordinates of the model while it learns. MpcLcsPolicy scales "
            "states itself: pass norm_obs=False, and policy_kwargs=dict(state_scale=...) to set the scale"
        )
