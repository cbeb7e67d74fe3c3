"""A thinned round of the campaign of wrong and right collects."""

from pathlib import Path

import pytest
from campaigns import wrong_collects
from support.plausible_collects import FAULTS, RECIPES, right_collect, wrong_collect

UNSEEN = {"lost frames, by the picture"}  # no promise: an edge of a field across the track looks the same


@pytest.mark.parametrize("number", range(len(FAULTS)))
def test_every_fault_is_named(number: int, tmp_path: Path) -> None:
    fault, strength = list(FAULTS)[number], number % 3
    texts = wrong_collects.said_of(
        wrong_collect(tmp_path / "c", fault, strength, seed=17), whole=fault == "flagged pixels"
    )
    assert wrong_collects.is_named(fault, texts) or fault in UNSEEN, texts


@pytest.mark.campaign
@pytest.mark.parametrize("kind", [kind for kind in RECIPES if kind != "traced"])
def test_right_ones_pass_without_a_word(kind: str, tmp_path: Path) -> None:
    assert wrong_collects.said_of(right_collect(tmp_path / "c", kind, seed=17)) == []


@pytest.mark.real_data
def test_real_files_pass_without_a_word(shared_data: Path) -> None:
    said = wrong_collects.judge_real(shared_data)
    assert len(said) == 14
    assert not any(said.values()), said
