"""Probes measure what they say: each against something known beforehand."""

from __future__ import annotations

import contextlib
import copy
import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from benchmarks.evaluation import RESET_SEEDS, Evaluator, controller_of, score
from benchmarks.learned_contacts import ContactTransitions
from benchmarks.probes import episode, model_quality, reuse, robustness
from benchmarks.probes.common import wrapped
from benchmarks.probes.model_quality import Windows, matrix_lines, windows
from benchmarks.probes.reuse import TaskEnv, leaning, regulator_at_rest, tasks
from benchmarks.probes.robustness import Change, changes
from benchmarks.references import contact_env, lqr
from contact_envs.dynamics import CartPoleParameters, integrate
from sb3_mpc_policy import LinearComplementaritySystem, QuadraticReward, hyperparams
from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.lqr import affine_lqr

HARD = "CartPoleSoftWallsHardPyBullet-v0"
ACROBOT = "AcrobotSoftLimitsPyBullet-v0"
FAR = {HARD: "wall_distance", ACROBOT: "limit_angle"}


def the_change(env_id: str, name: str, amount: float) -> Change:
    (found,) = (one for one in changes(env_id) if (one.change, one.amount) == (name, amount))
    return found


def trajectory(change: Change, actions: np.ndarray, seed: int = RESET_SEEDS[0]) -> np.ndarray:
    """(n+1, n_x) the observations of an episode under given actions."""
    with contextlib.closing(gym.make(change.spec)) as env:
        seen = [env.reset(seed=seed)[0]]
        for action in actions:
            seen.append(env.step(np.array([action], np.float32))[0])
    return np.array(seen)


# -- robustness --


@pytest.mark.parametrize("env_id", [HARD, ACROBOT])
def test_exactly_one_thing_differs_from_the_registered_environment(env_id: str) -> None:
    with contact_env(env_id) as registered:
        plant = registered.parameters
    for change in changes(env_id):
        with contact_env(change.spec) as env:
            assert (env.parameters != plant) is change.of_model, change
            assert bool(change.spec.additional_wrappers) is (change.change in ("noise", "delay")), change
    assert not gym.spec(env_id).additional_wrappers
    with contact_env(env_id) as registered:
        assert registered.parameters == plant


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_heavier_pole_is_heavier_in_the_equations_of_motion(factor: float) -> None:
    with contact_env(the_change(HARD, "pole mass", factor).spec) as env, contact_env(HARD) as registered:
        state = np.array([0.0, 0.3, 0.1, -0.4])
        x_ddot, theta_ddot = env.equations_of_motion(state, 1.0)[[1, 3]]
        cart, centre = registered.parameters.cart_mass, registered.parameters.mass_centre  # type: ignore[attr-defined]
        # the force changes the momentum of the cart and of the point mass at x + l_c sin(theta)
        of_pole = x_ddot + centre * (np.cos(0.1) * theta_ddot - np.sin(0.1) * 0.4**2)
        assert (1.0 - cart * x_ddot) / of_pole == pytest.approx(factor * registered.parameters.pole_mass)  # type: ignore[attr-defined]


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_longer_pole_touches_the_wall_from_further_away_and_falls_like_a_longer_pendulum(factor: float) -> None:
    with contact_env(the_change(HARD, "pole length", factor).spec) as env:
        tilted = np.array([0.0, 0.0, 1e-4, 0.0])
        tip = 0.35 - env.parameters.contact_gaps(tilted)[0]
        assert tip == pytest.approx(factor * 0.6e-4, rel=1e-6)
        A = env.true_lcs().A
    with contact_env(HARD) as registered:
        expected = registered.true_lcs().A
    # the rate of falling goes with 1 / sqrt(length)
    rates = [np.log(np.abs(np.linalg.eigvals(one)).max()) for one in (A, expected)]
    assert rates[0] / rates[1] == pytest.approx(factor**-0.5, rel=1e-6)


@pytest.mark.parametrize("stiffness", [200.0, 2000.0])
def test_a_changed_wall_pushes_with_its_own_stiffness_in_the_simulator(stiffness: float) -> None:
    deep = np.array([0.36, 0.0, 0.0, 0.0])
    spec = the_change(HARD, "wall stiffness", stiffness).spec
    spec.kwargs["physics_step"] = 1e-4  # the engine's error is of first order in it
    with contextlib.closing(gym.make(spec)) as env:
        env.reset(options={"state": deep})
        after = env.step(np.zeros(1, np.float32))[0]
    exact = integrate(deep, 0.0, 0.01, CartPoleParameters(wall_stiffness=stiffness))
    np.testing.assert_allclose(after[[1, 3]], exact[[1, 3]], rtol=0.01)


def test_a_lighter_link_of_the_acrobot_weighs_less() -> None:
    for name, share in (("upper mass", (0.7, 1.0)), ("lower mass", (1.0, 0.7))):
        with contact_env(the_change(ACROBOT, name, 0.7).spec) as env:
            lean = np.array([0.1, 0.0, 0.0, 0.0])
            energy = env.parameters.mechanical_energy(lean)
        upper, lower = 0.5 * 0.5 * share[0], 1.0 * 1.5 * share[1]  # mass times height, upright
        assert energy == pytest.approx(9.81 * np.cos(0.1) * (upper + lower))


def test_a_delayed_zero_is_a_zero() -> None:
    delay, nothing = the_change(HARD, "delay", 1.0), the_change(HARD, "nothing", 0.0)
    actions = np.zeros(40)
    np.testing.assert_array_equal(trajectory(delay, actions), trajectory(nothing, actions))


def test_a_delayed_action_acts_one_step_later() -> None:
    actions = np.array([0.5, -0.3, 0.8, 0.1, -0.6])
    delayed = trajectory(the_change(HARD, "delay", 1.0), actions)
    late = trajectory(the_change(HARD, "nothing", 0.0), np.concatenate([[0.0], actions[:-1]]))
    np.testing.assert_array_equal(delayed, late)


def test_noise_is_of_the_size_it_says_and_leaves_the_motion_alone() -> None:
    actions = np.zeros(60)
    quiet = trajectory(the_change(HARD, "nothing", 0.0), actions)
    noise = [trajectory(the_change(HARD, "noise", share), actions) - quiet for share in (0.002, 0.01)]
    np.testing.assert_allclose(noise[1], 5.0 * noise[0], atol=1e-12)  # else the states would part ways
    np.testing.assert_allclose(noise[1].std(axis=0), 0.01 * np.array([0.35, 1.0, 0.3, 1.0]), rtol=0.4)
    again = trajectory(the_change(HARD, "noise", 0.01), actions) - quiet
    np.testing.assert_array_equal(again, noise[1])
    other = [
        trajectory(the_change(HARD, *change), actions[:1], seed=5) for change in (("nothing", 0.0), ("noise", 0.01))
    ]
    assert not np.allclose(other[1] - other[0], noise[1][:2])


def test_what_is_scored_is_the_model_s_deterministic_policy() -> None:
    model = PPO("MlpPolicy", gym.make(HARD), n_steps=64, batch_size=64, seed=0, device="cpu")
    rows = robustness.probe(model, HARD, small=True)
    assert rows[0] == {"change": "nothing", "amount": 0.0, "quantity": "score",
                       "value": score(controller_of(model), HARD, 4)}  # fmt: skip
    assert [row["change"] for row in rows] == [
        "nothing",
        "pole mass",
        "pole length",
        "wall stiffness",
        "noise",
        "delay",
    ]
    assert len({row["value"] for row in rows}) >= 5  # the walls may be out of its reach


def test_the_table_of_references_tells_who_knows_of_the_change(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(robustness, "oracle", lambda env_id: asked.append(env_id) or lqr(env_id))
    robustness.main(["--env", HARD, "--episodes", "1", "--output", str(tmp_path / "table.csv")])
    lines = (tmp_path / "table.csv").read_text().splitlines()
    assert lines[0] == "env,controller,change,amount,quantity,value"
    assert len(lines) == 1 + 11 + 11 + 6
    assert asked[0] == HARD and all(spec.kwargs["parameters"] for spec in asked[1:]) and len(asked) == 7


def test_other_environments_are_refused() -> None:
    with pytest.raises(TypeError, match="env_id"):
        changes("Pendulum-v1")


# -- reuse --


def knowing(env_id: str, model: LcsMatrices[np.ndarray] | None = None) -> PPO:
    """The tuned policy, untrained, that starts from the true LCS, or another."""
    settings = hyperparams(env_id)
    arguments = settings.pop("policy_kwargs")
    with contact_env(env_id) as env:
        matrices = env.true_lcs() if model is None else model
    known = LinearComplementaritySystem.from_matrices(*matrices, state_scale=arguments.pop("state_scale"))
    return PPO(
        "MpcLcsPolicy", gym.make(env_id), device="cpu", policy_kwargs=arguments | {"initial_lcs": known}, **settings
    )


def true_model(env_id: str) -> LcsMatrices[np.ndarray]:
    with contact_env(env_id) as env:
        return LcsMatrices(*env.true_lcs())


def values(rows: list[dict], key: str) -> dict[str, float]:
    return {row["task"]: row["value"] for row in rows if row["controller"] == key}


@pytest.mark.parametrize("env_id", [HARD, ACROBOT])
def test_leaning_is_a_steady_state_that_a_contact_carries(env_id: str) -> None:
    with contact_env(env_id) as env:
        state, force = leaning(env.parameters)
        np.testing.assert_allclose(env.equations_of_motion(state, force), 0.0, atol=1e-9)
        right, left = env.parameters.contact_forces(state)
        assert right > 0.1 and left == 0.0
        assert abs(force) < 0.1 * env.max_force
        # without the contact it would fall: at rest for no force at all
        free = dataclasses.replace(env.parameters, **{FAR[env_id]: 10.0})
        falls = [free.equations_of_motion(state, u)[list(free.VELOCITIES)] for u in (force, force + 1.0)]
    slope = falls[1] - falls[0]
    assert np.abs(falls[0] - slope * (falls[0] @ slope) / (slope @ slope)).max() > 0.1


@pytest.mark.parametrize("env_id", [HARD, ACROBOT])
def test_the_place_to_hold_is_a_steady_state_without_contact(env_id: str) -> None:
    hold = next(task for task in tasks(env_id) if task.name == "hold")
    with contact_env(env_id) as env:
        target = np.asarray(hold.reward.target)
        assert not env.parameters.contact_forces(target).any() and target.any()
        still, pushed = (env.equations_of_motion(target, u)[list(env.parameters.VELOCITIES)] for u in (0.0, 1.0))
    slope = pushed - still
    np.testing.assert_allclose(still - slope * (still @ slope) / (slope @ slope), 0.0, atol=1e-9)


def test_a_task_pays_for_state_and_action_by_its_own_reward() -> None:
    reward = QuadraticReward([1.0, 2.0, 3.0, 4.0], 5.0, target=[0.1, 0.0, 0.0, 0.0], constant=7.0)
    with contextlib.closing(gym.make(wrapped(HARD, TaskEnv, reward=reward, start=None))) as env:
        s, _ = env.reset(seed=0)
        paid = env.step(np.array([0.5], np.float32))[1]
    assert paid == pytest.approx(7.0 - (s - [0.1, 0, 0, 0]) ** 2 @ [1.0, 2.0, 3.0, 4.0] - 5.0 * 0.25)


def test_the_environment_s_own_reward_as_a_task_pays_what_the_environment_pays() -> None:
    with contact_env(HARD) as plant:
        reward = QuadraticReward(plant.state_weights, plant.action_weight * plant.max_force**2, constant=15.0)
    spec = wrapped(HARD, TaskEnv, reward=reward, start=None)
    assert score(lqr(HARD), HARD, 2) == pytest.approx(_score_of(spec), rel=1e-6)


def _score_of(spec: gym.envs.registration.EnvSpec) -> float:
    with contextlib.closing(Evaluator(spec, 2)) as evaluator:
        return evaluator.score(lqr(HARD))


def test_episodes_of_leaning_start_there_and_move() -> None:
    lean = next(task for task in tasks(HARD) if task.name == "lean")
    with contextlib.closing(gym.make(wrapped(HARD, TaskEnv, reward=lean.reward, start=lean.start))) as env:
        starts = np.array([env.reset(seed=seed)[0] for seed in (1, 2, 1)]) - lean.start
    assert np.all(starts[:, [0, 2]] == 0.0) and np.all(np.abs(starts[:, [1, 3]]) <= 0.2)
    assert (starts[0] == starts[2]).all() and (starts[0] != starts[1]).any()


def test_the_regulator_of_least_cost_at_rest_is_that_of_the_wall_for_leaning_and_the_free_one_else() -> None:
    model = true_model(HARD)
    free = affine_lqr(model.A, model.B, model.d, *tasks(HARD)[0].reward.cost(4, 1)[:2])
    found = {task.name: regulator_at_rest(model, task.reward.cost(4, 1)) for task in tasks(HARD)}
    np.testing.assert_array_equal(found["hold"].K, free.K)
    # closed loop with the wall shut: it comes to rest where the steady state is, by the equations of motion
    lean = found["lean"]
    s = np.array([0.3, 0.0, 0.08, 0.0])
    for _ in range(3_000):
        a = lean.K @ s + lean.k
        lam = -(model.D[0] @ s + model.E[0] @ a + model.c[0]) / model.F[0, 0]
        s = model.A @ s + model.B @ a + model.C[:, 0] * lam
    with contact_env(HARD) as env:
        np.testing.assert_allclose(s, leaning(env.parameters)[0], atol=2e-3)


def test_the_true_model_scores_what_the_oracle_does_and_leaves_the_policy_as_it_is() -> None:
    model = knowing(HARD)
    before = copy.deepcopy(model.policy.state_dict())
    rows = reuse.probe(model, HARD, small=True)
    assert values(rows, "learned") == pytest.approx(values(rows, "oracle"), rel=1e-6)
    assert set(values(rows, "lqr")) == {"hold", "lean", "cost"}
    # LQR, which knows of no wall, stands up beside it: 0.1 rad at the weight of 400 costs 4 of 15 a step
    assert values(rows, "oracle")["lean"] > 5_900 > 5_000 > values(rows, "lqr")["lean"]
    for name, value in model.policy.state_dict().items():
        assert value is before[name] or (value == before[name]).all(), name


def test_a_model_without_contacts_cannot_lean() -> None:
    true = true_model(HARD)
    rows = reuse.probe(knowing(HARD, true._replace(C=0.0 * true.C)), HARD, small=True)
    assert values(rows, "learned")["lean"] < 5_000


def test_reuse_is_for_learned_models_in_the_environment_s_units() -> None:
    with pytest.raises(TypeError, match="MpcLcsPolicy"):
        reuse.probe(PPO("MlpPolicy", gym.make(HARD), device="cpu"), HARD, small=True)
    env = VecNormalize(DummyVecEnv([lambda: gym.make(HARD)]))
    with pytest.raises(ValueError, match="normalised"):
        reuse.probe(PPO("MpcLcsPolicy", env, device="cpu"), HARD, small=True)


# -- model quality --

SCALE, ACTION_SCALE = np.array([0.35, 1.0, 0.3, 1.0]), np.ones(1)


def matrix_errors(learned: LcsMatrices[np.ndarray], env_id: str = HARD) -> dict[tuple[str, str], float]:
    """(matrix, contact) -> error, and ("spurious", "") -> number."""
    lines = matrix_lines(learned, true_model(env_id), SCALE, ACTION_SCALE)
    return {(line.get("matrix", "spurious"), line.get("contact", "")): line["value"] for line in lines}


def renamed(model: LcsMatrices[np.ndarray], order: list[int], force: np.ndarray, gap: np.ndarray) -> LcsMatrices:
    """The same system with contacts in another order, and other units of their forces and gaps."""
    A, B, C, d, D, E, F, c = model
    C, D, E, F, c = C[:, order] * force, D[order], E[order], F[order][:, order], c[order]
    return LcsMatrices(A, B, C, d, D / gap[:, None], E / gap[:, None], F * force / gap[:, None], c / gap)


@pytest.mark.parametrize("env_id", [HARD, ACROBOT])
def test_the_true_model_has_no_error_in_its_matrices_and_that_of_the_true_one_in_its_predictions(env_id: str) -> None:
    rows = model_quality.probe(knowing(env_id), env_id, small=True)
    matrices = [row for row in rows if "matrix" in row]
    assert len(matrices) == 3 + 2 * 4
    assert max(row["value"] for row in matrices) < 1e-6
    assert [row["value"] for row in rows if row["quantity"] == "spurious contacts"] == [0.0]
    predictions = [[row["value"] for row in rows if row["model"] == name and "motion" in row]
                   for name in ("learned", "true")]  # fmt: skip
    assert len(predictions[0]) == 4
    np.testing.assert_allclose(*predictions, rtol=1e-6)


def test_order_and_units_of_contacts_do_not_matter() -> None:
    true = true_model(HARD)
    rng = np.random.default_rng(0)
    off = LcsMatrices(*(part * rng.uniform(0.9, 1.1, part.shape) for part in true))
    other = renamed(off, [1, 0], np.array([30.0, 0.2]), np.array([0.01, 3.0]))
    errors, of_other = matrix_errors(off), matrix_errors(other)
    assert min(errors[matrix, contact] for matrix in ("D", "effect") for contact in ("0", "1")) > 0.005
    assert of_other == pytest.approx(errors)
    s, a = rng.uniform(-SCALE, SCALE, (50, 4)), rng.uniform(-1.0, 1.0, (50, 1))
    moved = [reference_step(model, s, a) for model in (off, other)]
    np.testing.assert_allclose(*moved, atol=1e-9)


def reference_step(model: LcsMatrices[np.ndarray], s: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Eq (5) by trying every set of closed contacts."""
    A, B, C, d, D, E, F, c = model
    result = s @ A.T + a @ B.T + d
    for i, q in enumerate(s @ D.T + a @ E.T + c):
        for closed in ([], [0], [1], [0, 1]):
            lam = np.zeros(2)
            lam[closed] = -np.linalg.solve(F[np.ix_(closed, closed)], q[closed])
            if (lam >= 0).all() and (q + F @ lam >= -1e-9 * np.abs(q)).all():
                result[i] += C @ lam
                break
        else:
            raise AssertionError("no solution")
    return result


def test_a_model_that_stands_still_has_an_error_of_one() -> None:
    true = true_model(HARD)
    errors = matrix_errors(true._replace(A=np.eye(4), B=0.0 * true.B, C=0.0 * true.C, d=true.B[:, 0]))
    assert {key: errors[key] for key in (("A", ""), ("B", ""), ("d", ""))} == pytest.approx(
        {("A", ""): 1.0, ("B", ""): 1.0, ("d", ""): 1.0}
    )
    assert (errors["effect", "0"], errors["effect", "1"], errors["spurious", ""]) == (1.0, 1.0, 0.0)
    assert ("D", "0") not in errors


def test_what_is_wrong_with_a_contact_shows_where_it_is_wrong() -> None:
    true = true_model(HARD)
    softer = matrix_errors(true._replace(C=true.C * [0.5, 1.0]))
    assert softer == pytest.approx({key: 0.5 if key == ("effect", "0") else 0.0 for key in softer}, abs=1e-9)
    moved = matrix_errors(true._replace(c=true.c * [1.0, 1.1]))
    assert moved == pytest.approx({key: 0.1 if key == ("c", "1") else 0.0 for key in moved}, abs=1e-9)


def test_a_lost_contact_and_one_too_many_are_told_apart() -> None:
    true = true_model(HARD)
    errors = matrix_errors(true._replace(C=true.C * [0.0, 1.0]))
    assert (errors["effect", "0"], errors["effect", "1"]) == pytest.approx((1.0, 0.0), abs=1e-9)
    assert errors["spurious", ""] == 0.0
    extra = LcsMatrices(
        true.A, true.B, np.hstack([true.C, true.C[:, :1]]), true.d, np.vstack([true.D, [[0.0, 0.0, 1.0, 0.0]]]),
        np.vstack([true.E, [[0.0]]]), np.diag([*np.diag(true.F), 1.0]), np.append(true.c, 0.1),
    )  # fmt: skip
    assert matrix_errors(extra)["spurious", ""] == 1.0
    assert matrix_errors(extra)["effect", "0"] == pytest.approx(0.0, abs=1e-9)


def test_several_steps_of_free_motion_are_powers_of_the_matrix() -> None:
    true = true_model(HARD)
    rng = np.random.default_rng(0)
    s = 0.1 * rng.uniform(-SCALE, SCALE, (30, 4))
    test = Windows(s, np.zeros((30, 10, 1)), s @ np.linalg.matrix_power(true.A, 10).T)
    assert test.error(LinearComplementaritySystem.from_matrices(*true)) == pytest.approx(0.0, abs=1e-9)
    still = true._replace(A=np.eye(4))
    by_hand = np.sqrt(np.mean(((test.s_end - s) / (test.s_end - s).std(axis=0)) ** 2))
    assert test.error(LinearComplementaritySystem.from_matrices(*still)) == pytest.approx(by_hand)


def test_one_step_in_contact_is_measured_as_in_the_benchmark_of_learned_contacts() -> None:
    true = LinearComplementaritySystem.from_matrices(*true_model(HARD))
    assert windows(HARD)["contact", 1].error(true) == pytest.approx(ContactTransitions(HARD).error(true))


def test_contact_is_needed_in_contact_and_only_there() -> None:
    true = true_model(HARD)
    blind = LinearComplementaritySystem.from_matrices(*true._replace(C=0.0 * true.C))
    knows = LinearComplementaritySystem.from_matrices(*true)
    for (motion, _), test in windows(HARD, few=True).items():
        ratio = test.error(knows) / test.error(blind)
        assert ratio < 0.5 if motion == "contact" else ratio == pytest.approx(1.0, rel=0.2)


# -- episode -----------------------------------------------------------------------------------------------------------


def test_the_episode_told_is_the_one_that_is_scored() -> None:
    told = {(line["step"], line["quantity"]): line["value"] for line in episode.lines(lqr(HARD), HARD)}
    with contextlib.closing(Evaluator(HARD)) as evaluator:
        expected = evaluator.returns(lqr(HARD))[episode.EPISODE]
    last = max(step for step, _ in told)
    assert told[last, "return"] == pytest.approx(expected, abs=0.01)
    with contextlib.closing(gym.make(HARD)) as env:
        start, _ = env.reset(seed=RESET_SEEDS[episode.EPISODE])
    assert [told[0, f"state {i}"] for i in range(4)] == pytest.approx(start, abs=1e-4)
    assert len(episode.lines(lqr(HARD), HARD, most=20)) == 10 * 7
