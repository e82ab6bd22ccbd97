"""What the README shows runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.examples import examples_of, run_examples

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.slow
def test_the_examples_run_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(examples_of(README)) >= 3
    run_examples(README)
    assert (tmp_path / "mpc.zip").exists()
