"""The import: one alias and one callback for runs with this policy, and nothing for all others."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EvalCallback,
    EventCallback,
    EveryNTimesteps,
)
from stable_baselines3.common.monitor import Monitor

import sb3_mpc_policy
from sb3_mpc_policy import MpcLcsPolicy, PredictionLossCallback, registration
from tests.sb3_mpc_policy.toy_environments import every_callback, point_mass, policy_of, several, small_ppo

ALGORITHMS = pytest.mark.parametrize("algorithm", [PPO, A2C])
SIZES: dict[type, dict[str, Any]] = {PPO: dict(n_steps=16, batch_size=16, n_epochs=1), A2C: dict(n_steps=16)}


class Nothing(BaseCallback):
    """Any other callback."""

    def _on_step(self) -> bool:
        return True


def make(algorithm: type, policy: str = "MpcLcsPolicy") -> Any:
    kwargs = dict(horizon=2) if policy == "MpcLcsPolicy" else {}
    return algorithm(policy, several(2), policy_kwargs=kwargs, seed=0, device="cpu", **SIZES[algorithm])


def hooks(callback: BaseCallback) -> int:
    return sum(isinstance(child, PredictionLossCallback) for child in every_callback(callback))


CALLBACKS: dict[str, Callable[[], Any]] = {
    "none": lambda: None,
    "another": Nothing,
    "a list of others": lambda: [Nothing(), EveryNTimesteps(8, Nothing())],
    "a function": lambda: lambda locals_, globals_: True,
    "a list of functions": lambda: [lambda locals_, globals_: True, Nothing()],
    "evaluation": lambda: EvalCallback(Monitor(point_mass()), n_eval_episodes=1, eval_freq=8, verbose=0),
    "the hook": PredictionLossCallback,
    "a list with the hook": lambda: [Nothing(), PredictionLossCallback()],
    "CallbackList": lambda: CallbackList([Nothing(), PredictionLossCallback()]),
    "nested lists": lambda: [Nothing(), CallbackList([CallbackList([PredictionLossCallback()])])],
    "EventCallback": lambda: EventCallback(PredictionLossCallback()),
    "EveryNTimesteps": lambda: EveryNTimesteps(4, PredictionLossCallback()),
    "a list with EveryNTimesteps": lambda: [EveryNTimesteps(4, PredictionLossCallback()), PredictionLossCallback()],
}


@ALGORITHMS
@pytest.mark.parametrize("name", sorted(CALLBACKS))
def test_every_transition_is_recorded_once_whatever_callback_is_passed(algorithm: type, name: str) -> None:
    model = make(algorithm).learn(64, CALLBACKS[name]())
    assert len(policy_of(model).store) == model.num_timesteps == 64


@ALGORITHMS
def test_functions_are_called_and_the_hook_comes_first(algorithm: type) -> None:
    known = []

    def function(locals_: dict, globals_: dict) -> bool:
        known.append(len(locals_["self"].policy.store))
        return True

    make(algorithm).learn(32, function)
    assert known == list(range(2, 34, 2))


def test_the_progress_bar_works(capsys: pytest.CaptureFixture[str]) -> None:
    make(PPO).learn(32, progress_bar=True)
    assert "32/32" in "".join(capsys.readouterr())


@ALGORITHMS
@pytest.mark.parametrize("name", ["none", "another", "a function"])
def test_other_policies_get_the_callbacks_of_the_library(algorithm: type, name: str) -> None:
    model = make(algorithm, "MlpPolicy")
    root = model._init_callback(CALLBACKS[name]())
    assert hooks(root) == 0
    assert type(root) is (Nothing if name == "another" else ConvertCallback)
    model.learn(32)


STOCK = """
import sys
IMPORT
import hashlib, torch
from stable_baselines3 import A2C, PPO
torch.set_num_threads(1)
digest = hashlib.sha256()
for algorithm in (PPO, A2C):
    model = algorithm("MlpPolicy", "Pendulum-v1", n_steps=64, seed=3, device="cpu").learn(128)
    for parameter in model.policy.parameters():
        digest.update(parameter.detach().numpy().tobytes())
print("sb3_mpc_policy" in sys.modules, digest.hexdigest())
"""


def test_runs_with_other_policies_end_in_the_same_bits_with_and_without_the_import() -> None:
    results = []
    for line in ("", "import sb3_mpc_policy"):
        program = [sys.executable, "-c", STOCK.replace("IMPORT", line)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        done = subprocess.run(program, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        results.append(done.stdout.split()[-2:])
    assert [imported for imported, _ in results] == ["False", "True"]
    assert results[0][1] == results[1][1]


# -- where transitions are missing -----------------------------------------------------------------------------


@pytest.mark.parametrize("after_a_run", [False, True])
def test_a_loop_without_transitions_raises_and_says_what_to_do(after_a_run: bool) -> None:
    model = make(PPO)
    if after_a_run:
        model.learn(32)
    model._setup_learn(32)
    silent = CallbackList([Nothing()])
    silent.init_callback(model)
    model.collect_rollouts(model.env, silent, model.rollout_buffer, model.n_steps)
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    with pytest.raises(RuntimeError, match=r"no transitions.*PredictionLossCallback\(\)"):
        model.train()
    assert all((old == new).all() for old, new in zip(before, model.policy.parameters(), strict=True))


def test_an_algorithm_that_is_not_registered_works_with_the_callback_and_raises_without() -> None:
    class Own(PPO):
        _init_callback = PPO.__mro__[1]._init_callback  # stock's

    model = Own("MpcLcsPolicy", several(1), n_steps=16, batch_size=16, policy_kwargs=dict(horizon=2), device="cpu")
    with pytest.raises(RuntimeError, match="PredictionLossCallback"):
        model.learn(16)
    model.learn(16, PredictionLossCallback())
    assert len(policy_of(model).store) == 16


# -- registering -----------------------------------------------------------------------------------------------


@ALGORITHMS
def test_the_alias_is_known_and_sub_classes_inherit_it_and_the_hook(algorithm: type) -> None:
    sub_class = type("Sub", (algorithm,), {})
    assert algorithm.policy_aliases["MpcLcsPolicy"] is MpcLcsPolicy
    SIZES[sub_class] = SIZES[algorithm]
    model = make(sub_class).learn(32)
    assert len(policy_of(model).store) == 32


def test_the_class_serves_as_well_as_its_name_and_sub_classes_of_it_have_the_hook() -> None:
    class Sub(MpcLcsPolicy):
        pass

    model = PPO(Sub, several(1), n_steps=16, batch_size=16, policy_kwargs=dict(horizon=2), device="cpu").learn(16)
    assert len(policy_of(model).store) == 16


@pytest.mark.parametrize(
    "again",
    [
        registration.register,
        lambda: importlib.reload(sb3_mpc_policy),
        lambda: importlib.reload(registration).register(),
    ],
    ids=["register", "reload the package", "reload the module"],
)
def test_registering_twice_changes_nothing(again: Callable[[], object]) -> None:
    stock = [(dict(algorithm.policy_aliases), algorithm._init_callback) for algorithm in (PPO, A2C)]
    again()
    assert stock == [(algorithm.policy_aliases, algorithm._init_callback) for algorithm in (PPO, A2C)]
    model = small_ppo()
    assert hooks(model._init_callback(None)) == 1
    assert len(policy_of(model.learn(32)).store) == 32
