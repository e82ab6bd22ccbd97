"""What is saved comes back bit for bit, transitions and every argument included; what does not fit is refused."""

from __future__ import annotations

import copy
import inspect
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO

from sb3_mpc_policy import LinearComplementaritySystem, MpcLcsPolicy, QuadraticReward
from sb3_mpc_policy.solvers import CheckedSolver
from tests.sb3_mpc_policy.toy_environments import box_env, fingerprint, point_mass, policy_of, several, small_ppo

STATES = np.random.default_rng(0).normal(size=(6, 2))

# Two sets, so that together every argument differs from its default: a model and scales exclude each other, and so
# do a critic of one's own and the quadratic one.
ARGUMENTS: dict[str, dict[str, Any]] = {
    "one": dict(
        net_arch=dict(pi=[], vf=[7, 5]), activation_fn=torch.nn.ReLU, ortho_init=False, log_std_init=-1.1, horizon=4,
        n_contacts=3, reward=QuadraticReward([1.0, 2.0], 0.3, target=[0.1, 0.0], constant=2.0), terminal_value="none",
        penalty=50.0, smoothing=1e-3, n_iterations=3, solver="daqp", check=True, prediction_coef=7.0,
        prediction_loss="violation", model_fit="gradient", fit_updates=3, policy_gradient=False, replay=False,
        state_scale=[0.4, 0.9], action_scale=[0.3], normalize_images=False,
        share_features_extractor=False, optimizer_class=torch.optim.SGD, optimizer_kwargs=dict(momentum=0.5),
        features_extractor_kwargs={}, target_noise=0.7,
    ),
    "two": dict(
        terminal_value="critic", preset="paper", initial_lcs=LinearComplementaritySystem(2, 1, 1, [0.5, 0.7], [0.4]),
        reward=dict(state_weight=[1.0, 2.0], action_weight=0.3), solver="cvxpylayers", horizon=2,
    ),
    "auto": dict(n_contacts="auto", target_noise=0.5),
    "defaults": {},
}  # fmt: skip
# Not of this policy: what PPO passes, what is refused when it is not the default, and gSDE's.
NOT_CHOSEN = {
    "self", "observation_space", "action_space", "lr_schedule", "kwargs", "use_sde", "features_extractor_class",
    "args", "squash_output", "full_std", "use_expln",
}  # fmt: skip


def trained(name: str, **settings: Any) -> PPO:
    model = small_ppo(several(1), learning_rate=3e-3, **settings, **ARGUMENTS[name])
    if name == "two":
        return model.learn(32)
    return model.learn(64)


@pytest.fixture(scope="module", params=sorted(ARGUMENTS))
def model(request: pytest.FixtureRequest) -> PPO:
    return trained(request.param)


def same(one: Any, two: Any) -> bool:
    """Equality of arguments, of which some are modules or arrays."""
    if isinstance(one, torch.nn.Module):
        return isinstance(two, type(one)) and fingerprint(one) == fingerprint(two)
    return bool(np.all(np.asarray(one == two)))


def assert_same_policy(one: MpcLcsPolicy, two: MpcLcsPolicy) -> None:
    assert one is not two and fingerprint(one) == fingerprint(two)
    np.testing.assert_array_equal(one.store.rows(), two.store.rows())
    for first, second in ((one.predict(STATES, deterministic=True)[0], two.predict(STATES, deterministic=True)[0]),):
        np.testing.assert_array_equal(first, second)
    plan, other = one.plan(STATES), two.plan(STATES)
    for field in ("actions", "states", "contact_forces", "gaps", "cost", "complementarity", "status"):
        np.testing.assert_array_equal(getattr(plan, field), getattr(other, field))
    mine, others = one._get_constructor_parameters(), two._get_constructor_parameters()
    assert mine.keys() == others.keys()
    for name in mine:
        assert name == "lr_schedule" or same(mine[name], others[name]), name


def through_ppo(model: PPO, folder: Path) -> MpcLcsPolicy:
    model.save(folder / "model")
    return policy_of(PPO.load(folder / "model", device="cpu"))


def through_policy(model: PPO, folder: Path) -> MpcLcsPolicy:
    model.policy.save(str(folder / "policy.pt"))
    return MpcLcsPolicy.load(str(folder / "policy.pt"), device="cpu")


def through_parameters(model: PPO, folder: Path) -> MpcLcsPolicy:
    fresh = PPO("MpcLcsPolicy", several(1), policy_kwargs=model.policy_kwargs, device="cpu", seed=99)
    fresh.set_parameters(model.get_parameters())
    return policy_of(fresh)


def through_pickle(model: PPO, folder: Path) -> MpcLcsPolicy:
    return pickle.loads(pickle.dumps(model.policy))


def through_copy(model: PPO, folder: Path) -> MpcLcsPolicy:
    return copy.deepcopy(policy_of(model))


WAYS = {way.__name__: way for way in (through_ppo, through_policy, through_parameters, through_pickle, through_copy)}


@pytest.mark.parametrize("way", sorted(WAYS))
def test_predictions_plans_transitions_and_arguments_survive(way: str, model: PPO, tmp_path: Path) -> None:
    assert_same_policy(policy_of(model), WAYS[way](model, tmp_path))


def test_every_argument_of_the_constructor_is_among_those_tested_and_those_saved() -> None:
    known = {
        name
        for cls in (MpcLcsPolicy, MpcLcsPolicy.__base__, MpcLcsPolicy.__mro__[2], MpcLcsPolicy.__mro__[3])
        for name in inspect.signature(cls.__init__).parameters
    } - {"features_extractor"}
    chosen = {name for arguments in ARGUMENTS.values() for name in arguments}
    assert known - NOT_CHOSEN == chosen
    signature = inspect.signature(MpcLcsPolicy.__init__).parameters
    for arguments in ARGUMENTS.values():
        saved = policy_of(small_ppo(**arguments))._get_constructor_parameters()
        for name, value in arguments.items():
            expected = QuadraticReward(**value) if isinstance(value, dict) and name == "reward" else value
            assert same(saved[name], expected), name
            assert name not in signature or not same(value, signature[name].default), f"{name} is the default"


def test_the_arguments_act_after_loading(tmp_path: Path) -> None:
    policy = through_policy(trained("one"), tmp_path)
    assert isinstance(policy.optimizer, torch.optim.SGD) and policy.optimizer.defaults["momentum"] == 0.5
    assert [layer.out_features for layer in policy.mlp_extractor.value_net if hasattr(layer, "out_features")] == [7, 5]
    mpc = policy.mpc
    assert (mpc.horizon, mpc.penalty, mpc.smoothing, mpc.n_iterations) == (4, 50.0, 1e-3, 3)
    assert isinstance(mpc.solver, CheckedSolver) and type(mpc.solver.solver).__name__ == "DaqpSolver"
    assert type(mpc.terminal_value).__name__ == "NoValue"
    np.testing.assert_array_equal(mpc.cost_weight, np.diag([1.0, 2.0, 0.3]))


@pytest.mark.parametrize("name", sorted(ARGUMENTS))
def test_training_goes_on_after_loading_with_all_transitions(name: str, tmp_path: Path) -> None:
    model = trained(name)
    steps = model.num_timesteps
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model", env=several(1), device="cpu")
    loaded.learn(32, reset_num_timesteps=False)
    store = policy_of(loaded).store
    assert len(store) == loaded.num_timesteps == steps + 32
    np.testing.assert_array_equal(store.rows()[:steps], policy_of(model).store.rows())
    np.testing.assert_array_equal(policy_of(loaded).lcs.state_scale, policy_of(model).lcs.state_scale)
    assert all(value.isfinite().all() for value in loaded.policy.parameters())


def test_training_goes_on_without_replay_where_the_first_rollout_is_still_to_come(tmp_path: Path) -> None:
    model = small_ppo(several(1), replay=False).learn(64)
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model", env=several(1), device="cpu")
    loaded.learn(32, reset_num_timesteps=False)
    assert len(policy_of(loaded).store) == 96 and policy_of(loaded).mpc.cost_weight.isfinite().all()


def test_a2c_saves_and_loads(tmp_path: Path) -> None:
    model = A2C("MpcLcsPolicy", several(1), policy_kwargs=dict(horizon=3), device="cpu", seed=0).learn(20)
    model.save(tmp_path / "model")
    assert_same_policy(policy_of(model), policy_of(A2C.load(tmp_path / "model", device="cpu")))


def test_a_copy_learns_on_its_own() -> None:
    policy = policy_of(trained("defaults"))
    before, twin = fingerprint(policy), copy.deepcopy(policy)
    with torch.no_grad():
        for parameter in twin.parameters():
            parameter.add_(1.0)
    twin.store.add(np.zeros((1, 2)), np.zeros((1, 1)), np.zeros(1), np.zeros((1, 2)))
    assert fingerprint(policy) == before and len(policy.store) + 1 == len(twin.store)
    assert {id(parameter) for group in twin.optimizer.param_groups for parameter in group["params"]} == {
        id(parameter) for parameter in twin.parameters()
    }


def test_saved_parameters_do_not_follow_the_model() -> None:
    model = trained("defaults")
    saved = copy.deepcopy(model.get_parameters())
    before, n = fingerprint(model.policy), len(policy_of(model).store)
    model.learn(32, reset_num_timesteps=False)
    assert fingerprint(model.policy) != before
    model.set_parameters(saved)
    assert fingerprint(model.policy) == before and len(policy_of(model).store) == n


def test_some_parameters_may_be_set_alone() -> None:
    model = small_ppo()
    model.set_parameters({"policy": {"log_std": torch.tensor([-3.0])}}, exact_match=False)
    assert model.policy.log_std.item() == -3.0


def test_a_vector_of_parameters_keeps_the_precision_of_the_model() -> None:
    one, two = trained("defaults"), small_ppo(seed=7)
    types = [parameter.dtype for parameter in two.policy.parameters()]
    two.policy.load_from_vector(one.policy.parameters_to_vector())
    assert [parameter.dtype for parameter in two.policy.parameters()] == types
    for first, second in zip(one.policy.parameters(), two.policy.parameters(), strict=True):
        assert torch.equal(first, second)
    assert np.isfinite(two.predict(STATES)[0]).all()
    with pytest.raises(RuntimeError, match="split_sizes"):
        two.policy.load_from_vector(np.zeros(3))


# -- what does not fit -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env", "message"),
    [(lambda: box_env(3, 1), "Observation spaces do not match"), (lambda: box_env(2, 2), "spaces do not match")],
    ids=["states", "actions"],
)
def test_an_environment_of_another_shape_is_refused(env: Callable[[], Any], message: str, tmp_path: Path) -> None:
    small_ppo().save(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        PPO.load(tmp_path / "model", env=env(), device="cpu")


def test_parameters_of_another_number_of_contacts_are_refused() -> None:
    with pytest.raises(RuntimeError, match=r"size mismatch for action_net.lcs.C_scaled"):
        small_ppo(n_contacts=2).set_parameters(small_ppo(n_contacts=3).get_parameters())


@pytest.mark.parametrize("net_arch", [None, []], ids=["layers", "no layers"])
def test_files_of_another_policy_class_are_refused_by_name(net_arch: list[int] | None, tmp_path: Path) -> None:
    other = PPO("MlpPolicy", point_mass(), policy_kwargs=dict(net_arch=net_arch), device="cpu")
    other.save(tmp_path / "model")
    other.policy.save(str(tmp_path / "policy.pt"))

    with pytest.raises(ValueError, match=r"must be that of an MpcLcsPolicy.*another policy class, such as MlpPolicy"):
        small_ppo().set_parameters(str(tmp_path / "model"), device="cpu")
    with pytest.raises(ValueError, match=r"saved by MpcLcsPolicy; another policy class, such as MlpPolicy"):
        MpcLcsPolicy.load(str(tmp_path / "policy.pt"), device="cpu")
    # the algorithm's file names its class
    assert not isinstance(PPO.load(tmp_path / "model", device="cpu").policy, MpcLcsPolicy)
