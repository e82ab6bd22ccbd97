"""What a model's description says is what the model does."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from contact_envs.dynamics import true_lcs
from sb3_mpc_policy import LinearComplementaritySystem

STATES = [("x", "m"), ("x_dot", "m/s"), ("theta", "rad"), ("theta_dot", "rad/s")]
ACTIONS = [("force", "")]
NUMBER = r"([-+]?[\d.]+(?:e[-+]\d+)?)"


def cart_pole(unit: float = 1.0) -> LinearComplementaritySystem:
    """The cart-pole with 10 N, positions and velocities of the cart in units of so many metres."""
    A, B, C, d, D, E, F, c = true_lcs(action_scale=10.0)
    size = np.array([unit, unit, 1.0, 1.0])
    in_units = A * size / size[:, None], B / size[:, None], C / size[:, None], d / size, D * size, E, F, c
    return LinearComplementaritySystem.from_matrices(*in_units, state_scale=np.array([0.35, 1.0, 0.3, 1.0]) / size)


def two_walls(state_scale: Any = None, **changes: Any) -> LinearComplementaritySystem:
    """Two states and two contacts, closed where the first state is below −1 and above 1."""
    given = dict(
        A=np.eye(2), B=np.zeros((2, 1)), C=np.diag([1.0, -2.0]), d=np.zeros(2),
        D=np.array([[1.0, 0.0], [-1.0, 0.0]]), E=np.zeros((2, 1)), F=np.eye(2), c=np.ones(2),
    )  # fmt: skip
    return LinearComplementaritySystem.from_matrices(**(given | changes), state_scale=state_scale)


def of_contact(text: str, contact: int) -> str:
    """What a description says about one contact, numbered from 1."""
    return re.split(r"^contact \d+: |^F couples", text, flags=re.MULTILINE)[contact]


def coefficients(text: str) -> dict[str, float]:
    """Of the gap, without the leading term's."""
    condition = text.split("\n")[0]
    return {name: float(sign + size) for sign, size, name in re.findall(rf"([-+]) {NUMBER} (\S+)", condition)}


def changes(text: str) -> dict[str, float]:
    """State -> what a unit of depth adds to it, in the order of the text."""
    found = re.findall(rf"(\S+) by {NUMBER}", text.split("in one step:")[1])
    return {name: float(size) for name, size in found}


# -- the cart-pole ---------------------------------------------------------------------------------------------------


def test_the_walls_of_the_cart_pole_read_as_they_stand() -> None:
    text = cart_pole().describe(STATES, ACTIONS)
    assert text.startswith("2 of 2 contacts in use\n")
    for contact, side, at, side_open in ((1, ">", "0.350 m", "below"), (2, "<", "-0.350 m", "above")):
        wall = of_contact(text, contact)
        assert wall.startswith(f"touches where x + 0.600 theta + 0.00500 x_dot {side} {at}\n")
        assert f"along x alone: at x = {at} (open {side_open})" in wall
        assert "theta_dot" not in wall.split("\n")[0]  # 0.9 % of the largest term
        assert "force" not in wall


@pytest.mark.parametrize("contact", [1, 2])
def test_a_step_from_beyond_a_wall_changes_the_state_as_said(contact: int) -> None:
    lcs, depth = cart_pole(), 0.02
    sign = 1.0 if contact == 1 else -1.0
    beyond = np.array([sign * (0.35 + depth), 0.0, 0.0, 0.0])
    free = lcs.A.detach().numpy() @ beyond + lcs.d.detach().numpy()
    pushed = (lcs.step(beyond, np.zeros(1)).detach().numpy() - free) / depth
    said = changes(of_contact(lcs.describe(STATES, ACTIONS), contact))
    assert list(said) == ["theta_dot", "x_dot", "theta"]  # the largest first; x is below 1 %
    for (name, _), change in zip(STATES, pushed, strict=True):
        assert said.get(name, 0.0) == pytest.approx(change, rel=0.01, abs=0.02)


def test_units_change_the_numbers_and_not_what_is_said() -> None:
    metres = of_contact(cart_pole().describe(STATES, ACTIONS), 2)
    in_mm = [("x", "mm"), ("x_dot", "mm/s"), *STATES[2:]]
    millimetres = of_contact(cart_pole(unit=1e-3).describe(in_mm, ACTIONS), 2)
    assert "at x = -350 mm (open above)" in millimetres
    assert "each mm beyond it" in millimetres
    assert coefficients(metres) == {"theta": 0.6, "x_dot": 0.005}
    assert coefficients(millimetres) == {"theta": 600.0, "x_dot": 0.005}
    size = {"theta_dot": 1e-3, "x_dot": 1.0, "theta": 1e-3}
    assert changes(millimetres) == pytest.approx({name: size[name] * by for name, by in changes(metres).items()})


# -- any model -------------------------------------------------------------------------------------------------------


def test_states_and_actions_have_names_without_being_given_any() -> None:
    text = two_walls(E=np.array([[0.5], [0.0]])).describe()
    assert of_contact(text, 1) == (
        "touches where s[0] + 0.500 a[0] < -1.00\n"
        "  along s[0] alone: at s[0] = -1.00 (open above)\n"
        "  each unit beyond it changes, in one step: s[0] by +1.00\n"
    )


def test_the_leading_term_is_the_largest_in_scaled_coordinates() -> None:
    D = np.array([[1.0, 0.5], [-1.0, 0.0]])
    assert "touches where s[0] + 0.500 s[1] < -1.00" in two_walls(D=D).describe()
    assert "touches where s[1] + 2.00 s[0] < -2.00" in two_walls(D=D, state_scale=[1.0, 10.0]).describe()


def test_a_gap_has_the_unit_of_a_state_though_an_action_moves_it_more() -> None:
    text = two_walls(E=np.array([[-1000.0], [0.0]])).describe([("x", "m"), ("v", "m/s")], [("motor", "N")])
    assert "touches where x - 1000 motor < -1.00 m" in text


def test_a_gap_that_only_an_action_moves_has_its_unit() -> None:
    text = two_walls(D=np.zeros((2, 2)), E=np.array([[2.0], [-2.0]])).describe(actions=[("motor", "N")])
    assert "touches where motor < -0.500 N" in text
    assert "each N beyond it changes, in one step: s[0] by +2.00" in text


def test_a_gap_that_nothing_moves_is_open_or_closed_everywhere() -> None:
    text = two_walls(D=np.zeros((2, 2)), c=np.array([-0.5, 0.5])).describe()
    assert of_contact(text, 1) == "touches everywhere\n  that changes, in one step: s[0] by +0.500\n"
    assert of_contact(text, 2) == "touches nowhere"


def test_the_scale_of_gaps_and_of_forces_is_not_said() -> None:
    """C D / F is what acts on the state."""
    gap, force = 100.0, 7.0
    other = two_walls(
        C=np.diag([1.0, -2.0]) / force,
        D=gap * np.array([[1.0, 0.0], [-1.0, 0.0]]),
        F=gap / force * np.eye(2),
        c=gap * np.ones(2),
    )
    assert other.describe() == two_walls().describe()


def test_contacts_that_push_nothing_are_not_in_use() -> None:
    text = two_walls(C=np.array([[0.0, 1.0], [0.0, 0.0]])).describe()
    assert text.startswith("1 of 2 contacts in use\ncontact 1: not in use\ncontact 2: touches where s[0] > 1.00\n")


@pytest.mark.parametrize("coupled", [np.array([[1.0, 0.0], [0.3, 1.0]]), np.array([[1.0, -0.3], [0.0, 1.0]])])
def test_coupled_contacts_are_said_to_be(coupled: np.ndarray) -> None:
    assert "F couples contacts 1 and 2" in two_walls(F=coupled).describe()
    assert "couples" not in two_walls().describe()
    assert "couples" not in two_walls(F=coupled, C=np.zeros((2, 2))).describe()


def test_one_contact_is_not_spoken_of_as_many() -> None:
    assert LinearComplementaritySystem(2, 1, 1).describe().startswith("1 of 1 contact in use\n")


def test_a_linear_model_has_no_contacts() -> None:
    assert LinearComplementaritySystem(2, 1, 0).describe([("x", "m"), ("v", "m/s")]) == "no contacts"


@pytest.mark.parametrize(
    ("position", "text"),
    [(0.0, "0.00"), (99.97, "100"), (1234.4, "1234"), (0.000123456, "0.000123"), (-2.0, "-2.00"), (3e7, "3.00e+07")],
)
def test_numbers_have_three_digits(position: float, text: str) -> None:
    assert f"at s[0] = {text} (open above)" in two_walls(c=np.array([-position, 1.0])).describe()


# -- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given",
    [
        [("x", "m")],
        [("x", "m"), ("v", "m/s"), ("w", "1/s")],
        ["x", "v"],
        ["xm", "vs"],
        "xv",
        [("x", "m"), ("v", 1.0)],
        [("x", "m"), ("v", "m", "s")],
        [("x", "m"), ("", "m/s")],
        {"x": "m", "v": "m/s"},
        2,
    ],
    ids=str,
)
@pytest.mark.parametrize("n_contacts", [0, 2])
def test_names_that_do_not_fit_are_refused(given: Any, n_contacts: int) -> None:
    lcs = LinearComplementaritySystem(2, 2, n_contacts)
    for argument in ("states", "actions"):
        message = rf"^{argument} must be 2 pairs of strings \(name, unit\), names not empty, got "
        with pytest.raises(ValueError, match=message) as error:
            lcs.describe(**{argument: given})
        assert str(error.value).endswith(repr(given))
