"""The picture of the learned gaps draws what the model says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from stable_baselines3 import PPO

from benchmarks import gap_picture
from benchmarks.references import cart_pole
from sb3_mpc_policy import LinearComplementaritySystem
from sb3_mpc_policy.lcs import LcsMatrices, of_contacts

ENV_ID = "CartPoleSoftWallsHardPyBullet-v0"
SCALE = np.array([0.35, 1.0, 0.3, 1.0])


@pytest.fixture(scope="module")
def true() -> LcsMatrices[np.ndarray]:
    with cart_pole(ENV_ID) as env:
        return LcsMatrices(*env.true_lcs())


def saved_model(path: Path, true: LcsMatrices[np.ndarray]) -> PPO:
    """One that has learned nothing, and has seen one transition at the right wall."""
    lcs = LinearComplementaritySystem.from_matrices(*true, state_scale=SCALE)
    model = PPO("MpcLcsPolicy", ENV_ID, device="cpu", policy_kwargs={"initial_lcs": lcs})
    model.policy.store.add(np.array([[0.37, 0.0, 0.0, 0.0]]), np.zeros((1, 1)), np.zeros(1), np.zeros((1, 4)))
    model.save(path)
    return model


def test_the_picture_of_a_saved_model_is_drawn_and_its_contacts_are_said(
    tmp_path: Path, true: LcsMatrices[np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    saved_model(tmp_path / "model.zip", true)
    output = tmp_path / "folder" / "gaps.png"
    gap_picture.main(["--env", ENV_ID, "--model", str(tmp_path / "model.zip"), "--output", str(output)])
    with Image.open(output) as picture:
        assert picture.format == "PNG"
        assert picture.size == (1500, 840)
    assert 10_000 < output.stat().st_size < 200_000
    said = capsys.readouterr().out
    assert "2 of 2 contacts in use" in said
    assert "at x = -0.350 m" in said


def test_the_zero_lines_of_the_true_model_are_the_tangents_of_the_walls(true: LcsMatrices[np.ndarray]) -> None:
    right, left = gap_picture.gaps(true, true, SCALE)
    assert right is not None and left is not None
    theta = np.linspace(-0.05, 0.05, 11)
    tip = 0.6 * np.sin(theta)
    np.testing.assert_allclose(right(0.35 - tip, theta), 0.0, atol=1e-4)
    np.testing.assert_allclose(left(-0.35 - tip, theta), 0.0, atol=1e-4)
    # inside, and in metres along x
    assert right(np.array(0.25), np.array(0.0)) == pytest.approx(0.1)
    assert left(np.array(-0.45), np.array(0.0)) == pytest.approx(-0.1)


def test_a_model_that_is_the_true_one_has_the_true_gaps_however_it_is_written(true: LcsMatrices[np.ndarray]) -> None:
    """Contacts in the other order, with gaps and forces in other units, and one more that does nothing."""
    A, B, C, d, D, E, F, c = of_contacts(true, np.array([1, 0]))
    gap, force = 40.0, 3.0
    other = LcsMatrices(
        A, B, np.hstack([C / force, np.zeros((4, 1))]), d,
        np.vstack([gap * D, [[1.0, 0.0, 0.0, 0.0]]]), np.vstack([gap * E, [[0.0]]]),
        np.block([[gap / force * F, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]]), np.append(gap * c, 0.1),
    )  # fmt: skip
    for expected, found in zip(gap_picture.gaps(true, true, SCALE), gap_picture.gaps(true, other, SCALE), strict=True):
        assert found == pytest.approx(expected)


def test_a_wall_takes_the_stiffer_of_two_contacts_on_its_side(true: LcsMatrices[np.ndarray]) -> None:
    weak = of_contacts(true, np.array([0]))
    weak = weak._replace(C=0.1 * weak.C, c=weak.c - 0.1)
    both = LcsMatrices(
        true.A, true.B, np.hstack([weak.C, true.C]), true.d,
        np.vstack([weak.D, true.D]), np.vstack([weak.E, true.E]), np.eye(3) * true.F[0, 0], np.append(weak.c, true.c),
    )  # fmt: skip
    right, _ = gap_picture.gaps(true, both, SCALE)
    assert right is not None and right.offset == pytest.approx(0.35)


@pytest.mark.parametrize(("contacts", "missing"), [([0], [1]), ([1], [0]), ([], [0, 1])])
def test_a_wall_that_is_not_in_the_model_is_missing(
    tmp_path: Path, true: LcsMatrices[np.ndarray], contacts: list[int], missing: list[int]
) -> None:
    found = gap_picture.gaps(true, of_contacts(true, np.array(contacts, dtype=int)), SCALE)
    assert [k for k, gap in enumerate(found) if gap is None] == missing
    with cart_pole(ENV_ID) as env:
        gap_picture.draw(tmp_path / "gaps.png", env.parameters, found, found, np.zeros((0, 4)), "title", "learned")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("offset", [-9.0, 9.0])
def test_gaps_that_do_not_close_in_the_picture_are_drawn(tmp_path: Path, offset: float) -> None:
    far = gap_picture.Gap(1.0, -1.0, offset)
    with cart_pole(ENV_ID) as env:
        gap_picture.draw(tmp_path / "gaps.png", env.parameters, [far, far], [far, far], np.zeros((1, 4)), "title", "")


def test_the_foot_of_a_level_is_its_nearest_point_to_the_origin() -> None:
    gap, turn = gap_picture.Gap(-1.0, 0.5, 0.3), np.linspace(0.0, 2.0 * np.pi, 100_000)
    x, theta = gap.foot(0.1)
    assert gap(np.array(x), np.array(theta)) == pytest.approx(0.1)
    circle = np.hypot(x, theta) * np.array([np.cos(turn), np.sin(turn)])
    assert gap(*circle).min() == pytest.approx(0.1)  # the circle through it touches the level and does not cross


def test_transitions_in_contact_begin_or_end_there() -> None:
    free, left, right = np.zeros(4), np.array([-0.3, 0.0, -0.1, 0.0]), np.array([0.4, 1.0, 0.0, 0.0])
    s, s_next = np.array([free, free, right, left]), np.array([free, right, free, left])
    with cart_pole(ENV_ID) as env:
        found = gap_picture.in_contact(s, s_next, env.parameters)
    np.testing.assert_allclose(found, [right / 2.0, right / 2.0, left])


def test_other_environments_and_other_policies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="must name a cart-pole"):
        gap_picture.main(["--env", "AcrobotSoftLimitsPyBullet-v0", "--output", str(tmp_path / "gaps.png")])
    PPO("MlpPolicy", ENV_ID, device="cpu").save(tmp_path / "mlp.zip")
    with pytest.raises(
        TypeError, match=r"--model must name the file of an MpcLcsPolicy, got that of ActorCriticPolicy"
    ):
        gap_picture.main(
            ["--env", ENV_ID, "--model", str(tmp_path / "mlp.zip"), "--output", str(tmp_path / "gaps.png")]
        )
    assert not (tmp_path / "gaps.png").exists()


@pytest.mark.slow
def test_the_picture_is_drawn_after_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "gaps.png"
    gap_picture.main(["--env", ENV_ID, "--steps", "64", "--output", str(output)])
    assert output.exists()
    assert "of 2 contacts in use" in capsys.readouterr().out
