"""Both engines, whichever is installed."""

from __future__ import annotations

import pytest

MODULES = {"drake": "pydrake", "pybullet": "pybullet"}


@pytest.fixture(params=sorted(MODULES))
def engine(request: pytest.FixtureRequest) -> str:
    """The name of a simulator."""
    pytest.importorskip(MODULES[request.param])
    return request.param


@pytest.fixture
def both_engines() -> tuple[str, ...]:
    """The names of all simulators; the test is skipped unless all of them are installed."""
    for module in MODULES.values():
        pytest.importorskip(module)
    return tuple(sorted(MODULES))
