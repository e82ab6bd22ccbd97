"""The controller, eq (6): the best plan over the horizon for a learned contact model.

    maximise    Σ_{k<H} r(s_k, a_k) + V(s_H)
    subject to  s_{k+1} = A s_k + B a_k + C lam_k + d
                0 <= lam_k  ⟂  phi_k = D s_k + E a_k + F lam_k + c >= 0
                a_low <= a_k <= a_high,   s_0 given

The complementarity ``lam_k ⟂ phi_k`` is relaxed (problem.py): both factors stay non-negative, and their product is
replaced by its linearisation around a *nominal* trajectory of the LCS itself, weighted by the penalty rho. The
linearised product pushes down the gap where the nominal is in contact, and the force where it is not. One pass
solves that convex problem, then simulates the LCS under the new actions; the simulation is the next nominal. Of all
passes the plan whose simulation is cheapest is kept. The first nominal is the regulator (lqr.py) acting on the LCS.

The first passes have a weak penalty: their plans may lean on forces that do not exist, and so find contacts that the
nominal does not have. From pass to pass it stiffens, until forces and gaps exclude each other. What is then left to
choose are contacts that merely touch: force and gap are both zero, the plan fits either mode, and the next pass tries
the other one, which can only gain.

The plan's derivative with respect to the model (eq 9 to 11) is that of the pass that was kept; nominal, weights,
reward and terminal value are constants in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from torch import nn

from sb3_mpc_policy.lcs import LcsMatrices, LinearComplementaritySystem, Matrix, of_contacts
from sb3_mpc_policy.lqr import affine_lqr
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.reward import QuadraticCost, QuadraticReward, flat_cost
from sb3_mpc_policy.simulation import LcsRollout, LcsSimulator, LinearFeedback
from sb3_mpc_policy.solvers import CheckedSolver, Solution, make_solver
from sb3_mpc_policy.terminal_value import TERMINAL_VALUES, QuadraticCritic

__all__ = ["ControllerStatistics", "LcsMpc", "MpcPlan", "complementarity_weights"]

# Relative to the mean stage weight. They keep every problem strictly convex and change no plan that matters.
_FORCE_WEIGHT = 1e-4
_LEAST_ACTION_WEIGHT = 1e-6
# The penalty's growth from pass to pass, and its end.
_STIFFENING, _STIFFEST = 10.0, 1000.0
# Relative difference of costs that is rounding.
_SAME_COST = 1e-10
# A gap, or a force in units of gap, below this (scaled coordinates) is zero as far as contact modes go.
_TOUCHING = 1e-6
# Forces and gaps up to this, in scaled coordinates, are none: the solvers' tolerance.
_EXACT = 1e-9


@dataclass(frozen=True)
class MpcPlan:
    """Plans for a batch of states, environment units.

    :param actions: (N, H, n_a)
    :param states: (N, H+1, n_x), what the relaxed problem expects to happen
    :param contact_forces: (N, H, n_lambda), in the model's unit of force
    :param gaps: (N, H, n_lambda)
    :param cost: (N,) cost of eq (6) (minus the return and terminal value) when the LCS is simulated under the actions
    :param complementarity: (N,) largest product of force and gap, scaled coordinates; 0 where the relaxation is exact
    :param status: (N,) "solved", or "fallback" where the solver failed and the regulator's plan stands in
    """

    actions: np.ndarray
    states: np.ndarray
    contact_forces: np.ndarray
    gaps: np.ndarray
    cost: np.ndarray
    complementarity: np.ndarray
    status: np.ndarray


@dataclass
class ControllerStatistics:
    """Counts since the last reset, for logging."""

    plans: int = 0
    failed: int = 0
    in_contact: int = 0
    complementarity: float = 0.0
    seconds: float = 0.0


def complementarity_weights(
    forces: np.ndarray, gaps: np.ndarray, stiffness: np.ndarray, penalty: float, smoothing: float
) -> ComplementarityWeights:
    """Weights that linearise ``lam phi = 0`` around a nominal, normalised to the sum ``penalty``.

    With ``u = F_ii lam − phi`` of the nominal, the force (in units of gap) and the gap that have this difference and
    the product epsilon are ``(±u + sqrt(u² + 4 epsilon)) / 2``; the gap's weight is the force's share of their sum.
    For epsilon = 0 that is the penalty in contact and nothing out of it.

    :param forces: (N, H, n_lambda) nominal lam
    :param gaps: (N, H, n_lambda) nominal phi
    :param stiffness: (n_lambda,) diagonal of F, which turns forces into gaps
    :param penalty: rho > 0
    :param smoothing: epsilon >= 0
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of a model that explodes; no solver takes what comes of it
        u = forces * stiffness - gaps
        share = 0.5 + 0.5 * (u / np.hypot(u, 2.0 * np.sqrt(smoothing)) if smoothing else np.sign(u))
    return ComplementarityWeights(penalty * share, penalty * (1.0 - share) * stiffness)


class LcsMpc(nn.Module):
    """Model-predictive control over an LCS, differentiable with respect to the model.

    :param lcs: the model
    :param reward: a :class:`QuadraticReward`; None while it is still to be learned (:meth:`set_cost`)
    :param action_low: (n_a,) lower bounds, environment units; may be -inf
    :param action_high: (n_a,)
    :param horizon: H >= 1
    :param terminal_value: "riccati", "critic" or "none"
    :param penalty: rho > 0 of the first pass, relative to the mean stage weight in scaled coordinates; it grows
        tenfold from pass to pass, up to a thousand times the first
    :param smoothing: epsilon >= 0, scaled coordinates
    :param n_iterations: most passes of the relaxation, >= 1; a state whose next pass would change nothing has fewer
    :param solver: "auto", "daqp", "torch" or "cvxpylayers"
    :param check: whether every solution must meet the optimality conditions (solvers/check.py); one that does not is
        replaced like one that was not found
    """

    cost_weight: torch.Tensor
    cost_slope: torch.Tensor

    def __init__(
        self,
        lcs: LinearComplementaritySystem,
        reward: QuadraticReward | None,
        action_low: np.ndarray,
        action_high: np.ndarray,
        horizon: int = 10,
        terminal_value: str = "riccati",
        penalty: float = 100.0,
        smoothing: float = 0.0,
        n_iterations: int = 6,
        solver: str = "auto",
        check: bool = False,
    ) -> None:
        super().__init__()
        for name, value in (("horizon", horizon), ("n_iterations", n_iterations)):
            if int(value) != value or value < 1:
                raise ValueError(f"{name} must be an integer >= 1, got {value!r}")
        if not (np.isfinite(penalty) and penalty > 0):
            raise ValueError(f"penalty must be a finite number > 0, got {penalty!r}")
        if not (np.isfinite(smoothing) and smoothing >= 0):
            raise ValueError(f"smoothing must be a finite number >= 0, got {smoothing!r}")
        if terminal_value not in TERMINAL_VALUES:
            raise ValueError(f"terminal_value must be one of {sorted(TERMINAL_VALUES)}, got {terminal_value!r}")
        low, high = (np.asarray(bound, dtype=np.float64) for bound in (action_low, action_high))
        if low.shape != (lcs.n_actions,) or high.shape != low.shape or not (low < high).all():
            raise ValueError(
                f"action_low and action_high must be {lcs.n_actions} numbers with low < high, "
                f"got {action_low!r} and {action_high!r}"
            )
        self.lcs = lcs
        self.action_low, self.action_high = low, high
        self.horizon, self.n_iterations = int(horizon), int(n_iterations)
        self.penalty, self.smoothing = float(penalty), float(smoothing)
        self.terminal_value = TERMINAL_VALUES[terminal_value]()
        self.solver = CheckedSolver(make_solver(solver)) if check else make_solver(solver)
        self.statistics = ControllerStatistics()
        self._problem: RelaxedProblem | None = None
        self._problem_key: bytes = b""
        self._simulator: LcsSimulator
        self._used = np.arange(lcs.n_contacts)

        n_x, n_a = lcs.n_states, lcs.n_actions
        for name, shape in (
            ("cost_weight", (n_x + n_a, n_x + n_a)),
            ("cost_slope", (n_x + n_a,)),
            ("terminal_weight", (n_x, n_x)),
            ("terminal_slope", (n_x,)),
            ("feedback_gain", (n_a, n_x)),
            ("feedback_offset", (n_a,)),
        ):
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))
        # all that a problem is made of, by name: torch's own iterators take longer than a solve
        self._tensors = [
            [name for name, _ in (*owner.named_parameters(recurse=False), *owner.named_buffers(recurse=False))]
            for owner in (self, lcs)
        ]
        scales = self._numpy("state_scale", lcs), self._numpy("action_scale", lcs)
        self.set_cost(flat_cost(*scales) if reward is None else reward.cost(n_x, n_a))
        self.refresh()

    # -- what is constant between two refreshes -----------------------------------------------------------------

    def set_cost(self, cost: QuadraticCost) -> None:
        """Change the stage cost (environment units). :meth:`refresh` makes the terminal value follow."""
        self.cost_weight.copy_(torch.as_tensor(cost.W))
        self.cost_slope.copy_(torch.as_tensor(cost.w))

    def refresh(self, critic: QuadraticCritic | None = None, reward_scale: float = 1.0) -> str:
        """Recompute the nominal feedback and the terminal value from the current model and cost.

        :param critic: for ``terminal_value="critic"``
        :param reward_scale: what the rewards that the critic saw were divided by
        :return: how the regulator was found ("riccati", "finite horizon" or "stage cost")
        """
        W, w = self._scaled_cost()
        A, B, _, d, *_ = self._numpy_model()
        lqr = affine_lqr(A, B, d, W, w)
        if self.terminal_value.needs_quadratic_critic and critic is None:
            P, p = np.zeros_like(lqr.P), np.zeros_like(lqr.p)  # nothing is learned yet
        else:
            P, p = self.terminal_value.quadratic(lqr, critic, reward_scale)
        for name, value in (
            ("terminal_weight", P),
            ("terminal_slope", p),
            ("feedback_gain", lqr.K),
            ("feedback_offset", lqr.k),
        ):
            getattr(self, name).copy_(torch.as_tensor(value))
        return lqr.source

    def target(self) -> np.ndarray:
        """(n_x,) the state of least cost, environment units: where the controller tries to be."""
        n_x = self.lcs.n_states
        W, w = self._scaled_cost()
        best: np.ndarray = -0.5 * np.linalg.pinv(W[:n_x, :n_x], rcond=1e-6) @ w[:n_x]
        return best * self._numpy("state_scale", self.lcs)

    def _numpy(self, name: str, owner: nn.Module | None = None) -> np.ndarray:
        tensor: torch.Tensor = getattr(owner or self, name)
        return tensor.detach().cpu().numpy()

    def _numpy_model(self) -> LcsMatrices[np.ndarray]:
        return LcsMatrices(*(matrix.detach().cpu().numpy() for matrix in self.lcs.scaled()))

    def _of_used(self, model: LcsMatrices[Matrix]) -> LcsMatrices[Matrix]:
        """A model without the contacts that :meth:`_current_problem` has found to do nothing."""
        return model if len(self._used) == self.lcs.n_contacts else of_contacts(model, self._used)

    def _scaled_cost(self) -> tuple[np.ndarray, np.ndarray]:
        scale = np.concatenate([self._numpy("state_scale", self.lcs), self._numpy("action_scale", self.lcs)])
        W = self._numpy("cost_weight") * np.outer(scale, scale)
        actions = slice(self.lcs.n_states, None)
        floor = _LEAST_ACTION_WEIGHT * _mean_weight(W) * np.eye(self.lcs.n_actions)
        W[actions, actions] += floor
        return W, self._numpy("cost_slope") * scale

    def _current_problem(self) -> RelaxedProblem:
        """The problem for the present parameters, and the simulator beside it; kept while they do not change."""
        owners = zip((self, self.lcs), self._tensors, strict=True)
        key = b"".join(self._numpy(name, owner).tobytes() for owner, names in owners for name in names)
        if self._problem is None or key != self._problem_key:
            W, w = self._scaled_cost()
            action_scale = self._numpy("action_scale", self.lcs)
            model = self._numpy_model()
            self._used = _in_use(model)
            self._problem = RelaxedProblem(
                model=LcsMatrices(*(matrix.copy() for matrix in self._of_used(model))),
                stage_weight=W,
                stage_slope=w,
                terminal_weight=self._numpy("terminal_weight").copy(),
                terminal_slope=self._numpy("terminal_slope").copy(),
                action_low=self.action_low / action_scale,
                action_high=self.action_high / action_scale,
                horizon=self.horizon,
                force_weight=_FORCE_WEIGHT * _mean_weight(W),
                device=str(self.cost_weight.device),
            )
            self._problem_key = key
            gain, offset = self._numpy("feedback_gain").copy(), self._numpy("feedback_offset").copy()
            feedback = LinearFeedback(gain, offset, self._problem.action_low, self._problem.action_high)
            self._simulator = LcsSimulator(self._problem.model, feedback)
        return self._problem

    # -- the relaxation loop ------------------------------------------------------------------------------------

    def _solve(
        self, problem: RelaxedProblem, s0: np.ndarray, previous: np.ndarray | None = None
    ) -> tuple[Solution, ComplementarityWeights, np.ndarray]:
        """The best pass for each of s0 (N, n_x): its solution, its weights, and its cost under the LCS itself."""
        nominal = self._first_nominal(problem, s0, previous)
        weights = self._weights(problem, nominal, self._penalty(problem, 0))
        solution, cost, nominal = self._one_pass(problem, s0, weights)
        todo = np.arange(len(s0))
        best, best_cost = solution[todo], cost.copy()
        best_weights = ComplementarityWeights(weights.gap.copy(), weights.force.copy())
        for number in range(1, self.n_iterations):
            following = self._weights(problem, nominal, self._penalty(problem, number), weights)
            again = np.flatnonzero(~_finished(problem, solution, weights, following))
            if not len(again):
                break
            todo = todo[again]
            weights = ComplementarityWeights(following.gap[again], following.force[again])
            solution, cost, nominal = self._one_pass(problem, s0[todo], weights)
            # of two that cost the same, the stiffer: it leans less on forces that do not exist
            enough = best_cost[todo] + _SAME_COST * np.abs(best_cost[todo])
            better = solution.solved & (~best.solved[todo] | (cost <= enough))
            best.replace(todo[better], solution[better])
            best_cost[todo[better]] = cost[better]
            best_weights.gap[todo[better]] = weights.gap[better]
            best_weights.force[todo[better]] = weights.force[better]
        return best, best_weights, best_cost

    def _one_pass(
        self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights
    ) -> tuple[Solution, np.ndarray, LcsRollout]:
        """Solve the relaxed problem; simulate the LCS under its actions; the cost of that simulation."""
        solution = self.solver.solve(problem, s0, weights)
        self._stand_in(problem, solution, s0)
        rollout = self._simulated(s0, solution)
        return solution, problem.cost(rollout.states, solution.actions), rollout

    def _simulated(self, s0: np.ndarray, solution: Solution) -> LcsRollout:
        """The LCS itself under the solution's actions."""
        # A plan without any product of force and gap is a trajectory of the LCS, which has only one for these actions.
        product = np.minimum(solution.forces, solution.gaps).reshape(len(s0), -1)
        rest = np.flatnonzero(~(np.abs(product).max(axis=1, initial=0.0) <= _EXACT) | ~solution.solved)
        if len(rest) == len(s0):
            return self._simulator.under(s0, solution.actions)
        rollout = LcsRollout(solution.states, solution.actions, solution.forces, solution.gaps)
        if len(rest):
            rollout = LcsRollout(*(part.copy() for part in rollout))
            for whole, part in zip(rollout, self._simulator.under(s0[rest], solution.actions[rest]), strict=True):
                whole[rest] = part
        return rollout

    def _first_nominal(self, problem: RelaxedProblem, s0: np.ndarray, previous: np.ndarray | None) -> LcsRollout:
        nominal = self._simulator.regulated(s0, problem.horizon)
        if previous is not None:
            shifted = self._simulator.under(s0, previous)
            better = problem.cost(shifted.states, shifted.actions) < problem.cost(nominal.states, nominal.actions)
            for mine, other in zip(nominal, shifted, strict=True):
                mine[better] = other[better]
        return nominal

    def _penalty(self, problem: RelaxedProblem, number: int) -> float:
        """rho of a pass: ten times stiffer from pass to pass, up to a thousandfold."""
        return self.penalty * min(_STIFFENING**number, _STIFFEST) * _mean_weight(problem.stage_weight)

    def _weights(
        self,
        problem: RelaxedProblem,
        nominal: LcsRollout,
        penalty: float,
        before: ComplementarityWeights | None = None,
    ) -> ComplementarityWeights:
        """Weights around a nominal; where it only touches, the mode that the pass before (``before``) did not have.

        Both modes allow a plan that touches, so the next pass can only gain by the change.
        """
        stiffness = problem.stiffness
        weights = complementarity_weights(nominal.forces, nominal.gaps, stiffness, penalty, self.smoothing)
        if before is not None:
            touching = (nominal.forces * stiffness < _TOUCHING) & (nominal.gaps < _TOUCHING)
            contact = ~_in_contact(problem, before)
            weights.gap[touching] = np.where(contact, penalty, 0.0)[touching]
            weights.force[touching] = np.where(contact, 0.0, penalty * stiffness)[touching]
        return weights

    def _stand_in(self, problem: RelaxedProblem, solution: Solution, s0: np.ndarray) -> None:
        """Put the regulator's plan, simulated on the LCS, where the solver failed; a zero action if even that fails."""
        failed = np.flatnonzero(~solution.solved)
        if not len(failed):
            return
        with np.errstate(all="ignore"):
            safe = self._first_nominal(problem, s0[failed], None)
        actions = np.where(np.isfinite(safe.actions), safe.actions, 0.0)
        solution.actions[failed] = np.clip(actions, problem.action_low, problem.action_high)
        solution.states[failed], solution.forces[failed], solution.gaps[failed] = (
            safe.states,
            safe.forces,
            safe.gaps,
        )

    def _count(self, solution: Solution, seconds: float) -> None:
        self.statistics.seconds += seconds
        self.statistics.plans += len(solution.solved)
        self.statistics.failed += int((~solution.solved).sum())
        self.statistics.in_contact += int((solution.forces > 1e-9).any(axis=(1, 2)).sum())
        worst = _complementarity(solution).max(initial=0.0)
        self.statistics.complementarity = max(self.statistics.complementarity, float(worst))

    # -- public ---------------------------------------------------------------------------------------------------

    def plan(self, s: np.ndarray, previous: MpcPlan | None = None) -> MpcPlan:
        """Plan from each state.

        :param s: (N, n_x) or (n_x,), environment units
        :param previous: the plans made one step earlier for the same N systems; shifted by one step they compete with
            the regulator for the first nominal
        :raise ValueError: for a state of the wrong shape or one that is not finite
        """
        state = self._states(np.asarray(s, dtype=np.float64))
        shifted = None
        action_scale = self._numpy("action_scale", self.lcs)
        if previous is not None:
            expected = (len(state), self.horizon, self.lcs.n_actions)
            if previous.actions.shape != expected:
                raise ValueError(f"previous must hold actions of shape {expected}, got {previous.actions.shape}")
            shifted = np.concatenate([previous.actions[:, 1:], previous.actions[:, -1:]], axis=1) / action_scale
        problem = self._current_problem()
        solution, _, cost = self._solve(problem, state / self._numpy("state_scale", self.lcs), shifted)
        forces, gaps = self._of_all_contacts(solution)
        return MpcPlan(
            actions=solution.actions * action_scale,
            states=solution.states * self._numpy("state_scale", self.lcs),
            contact_forces=forces * self._numpy("force_scale", self.lcs),
            gaps=gaps * self._numpy("gap_scale", self.lcs),
            cost=cost,
            complementarity=_complementarity(solution),
            status=np.where(solution.solved, "solved", "fallback"),
        )

    def _of_all_contacts(self, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
        """Forces and gaps (N, H, n_lambda), those of contacts that do nothing as they follow from the plan."""
        if len(self._used) == self.lcs.n_contacts:
            return solution.forces, solution.gaps
        _, _, _, _, D, E, F, c = self._numpy_model()
        gaps = solution.states[:, :-1] @ D.T + solution.actions @ E.T + c
        forces = np.maximum(-gaps / np.diag(F), 0.0)
        forces[..., self._used] = solution.forces
        gaps += forces * np.diag(F)
        gaps[..., self._used] = solution.gaps
        return forces, gaps

    def forward(self, s: torch.Tensor) -> torch.Tensor:
        """The first action of the plan, the policy's mean mu(s), differentiable in the model and in s.

        A failed solve gives the regulator's action without gradient.

        :param s: (N, n_x), environment units
        :return: (N, n_a) of the same dtype
        """
        scaled = s.to(torch.float64) / self.lcs.state_scale
        self._states(s.detach().cpu().numpy())
        started = perf_counter()
        problem = self._current_problem()
        s0 = scaled.detach().cpu().numpy()
        solution, weights, _ = self._solve(problem, s0)
        self._count(solution, perf_counter() - started)
        actions = torch.as_tensor(solution.actions[:, 0], device=s.device)
        if torch.is_grad_enabled() and solution.solved.any():
            index = np.flatnonzero(solution.solved)
            some = ComplementarityWeights(weights.gap[index], weights.force[index])
            model = self._of_used(self.lcs.scaled())
            found = self.solver.differentiable_actions(problem, model, scaled[index], some, solution[index])
            actions = actions.index_put((torch.as_tensor(index, device=s.device),), found[:, 0])
        return (actions * self.lcs.action_scale).to(s.dtype)

    def _states(self, s: np.ndarray) -> np.ndarray:
        state = np.atleast_2d(s)
        if state.ndim != 2 or state.shape[1] != self.lcs.n_states:
            raise ValueError(f"states must have shape (N, {self.lcs.n_states}), got {s.shape}")
        if not np.isfinite(state).all():
            row = state[~np.isfinite(state).all(axis=1)][0]
            raise ValueError(f"observations must be finite, got {row}")
        return state


def _mean_weight(W: np.ndarray) -> float:
    """The size of the cost in scaled coordinates, to which penalty and regularisation are relative."""
    return max(float(np.trace(W)) / len(W), 1e-12)


def _in_use(model: LcsMatrices[np.ndarray]) -> np.ndarray:
    """Index of the contacts that move the state, or are coupled to others and so may."""
    coupled = model.F.copy()
    np.fill_diagonal(coupled, 0.0)
    return np.flatnonzero(model.C.any(axis=0) | coupled.any(axis=0) | coupled.any(axis=1))


def _in_contact(problem: RelaxedProblem, weights: ComplementarityWeights) -> np.ndarray:
    """(N, H, n_lambda) the mode that the weights ask for: whether they push the gap down rather than the force."""
    return weights.gap * problem.stiffness > weights.force


def _finished(
    problem: RelaxedProblem, solution: Solution, weights: ComplementarityWeights, following: ComplementarityWeights
) -> np.ndarray:
    """(N,) whether the following, stiffer pass would find the same solution again, or this one found none.

    It is the same where both ask for one mode, and nothing is left of what they push down.
    """
    mode = _in_contact(problem, weights)
    left = np.where(mode, solution.gaps, solution.forces * problem.stiffness)
    done = (mode == _in_contact(problem, following)) & (left < _TOUCHING)
    result: np.ndarray = done.all(axis=(1, 2)) | ~solution.solved
    return result


def _complementarity(solution: Solution) -> np.ndarray:
    """(N,) the largest product of a force and its gap."""
    if not solution.forces.size:
        return np.zeros(len(solution.forces))
    return np.abs(solution.forces * solution.gaps).max(axis=(1, 2))
