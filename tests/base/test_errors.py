"""Errors a user can catch by what they are, and that name everything at once."""

import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.key_tables import DOCS, PAGES, key_table, with_tables
from support.refusals import expect_error, expect_words

import hyperpaint
from hyperpaint.base import errors
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import (
    PARAMETERS,
    Fact,
    arguments_of,
    by_key,
    check_fields,
    declared,
    documented,
    fact,
    is_number,
)
from hyperpaint.simulation.settings import SimulationSettings


def test_every_error_has_the_base_and_a_builtin() -> None:
    builtin = {
        "UnitsError": ValueError,
        "SchemaError": ValueError,
        "FormatError": ValueError,
        "TimeError": ValueError,
        "CollectError": ValueError,
        "StoreError": OSError,
        "IncompleteStoreError": errors.StoreError,
        "MissingExtraError": ImportError,
    }
    for name, parent in builtin.items():
        error = getattr(errors, name)
        assert issubclass(error, errors.PaintError)
        assert issubclass(error, parent)
        assert getattr(hyperpaint.errors, name) is error
    assert issubclass(errors.PaintWarning, UserWarning)


def test_errors_survive_a_process_boundary() -> None:
    # a task that fails on a worker must not fail twice
    for name in errors.__all__:
        error = getattr(errors, name)
        if isinstance(error, type) and issubclass(error, errors.PaintError):
            copy = pickle.loads(pickle.dumps(error("2 lights", expected="1", code="light-number")))
            assert (str(copy), copy.codes) == ("2 lights, expected 1 [light-number]", ("light-number",))


def test_problems_are_listed_together() -> None:
    problems = errors.Problems("the file", errors.FormatError)
    problems.raise_if_any()
    problems.add("one")
    problems.add("two\nlines")
    assert (list(problems), len(problems)) == (["one", "two\nlines"], 2)
    caught = expect_error(errors.FormatError, None, lambda: problems.raise_if_any())
    assert str(caught) == "the file:\n  one\n  two\n  lines"


def test_a_missing_extra_says_how_to_install_it() -> None:
    error = errors.MissingExtraError.of("matplotlib", "viz", "a picture")
    assert error.codes == ("extra-missing",)
    assert "hyperpaint[viz]" in error.problem.mend


# --- Facts: checks, messages, docstrings and tables that follow from one declaration


@pytest.mark.parametrize(
    ("options", "good", "bad"),
    [
        ({"kind": "number"}, [0, -1.5, np.float32(2)], [True, "1", None, float("nan"), 10**400]),
        ({"kind": "number", "least": 0, "above": True, "most": 1.2}, [1.2, 1e-9], [0, 1.3, -1]),
        ({"kind": "number", "least": 0, "most": 1, "below": True}, [0, 0.99], [1, -0.1]),
        ({"kind": "whole", "least": 1, "most": 16}, [1, 16, np.int64(3)], [0, 17, 2.0, True]),
        ({"kind": "flag"}, [True, False], [1, "true", None]),
        ({"kind": "choice", "choices": ("a", "b")}, ["a"], ["c", 1, ["a"], None]),
        ({"kind": "text"}, ["a"], ["", " ", 3]),
        ({"kind": "texts"}, ["a", ["a", "b"]], [[], ["a", 3], ""]),
        ({"kind": "words"}, [[], ["a"]], ["a", [3]]),
        ({"kind": "words", "choices": ("a",)}, [[], ["a"]], ["a", ["b"]]),
        ({"kind": "numbers", "length": 2}, [[1, 2], (1.0, 2.0)], [[1], 1, [1, "2"], [1, True]]),
        ({"kind": "numbers", "single": True, "least": 0}, [1, [1, 2, 3], np.ones(2)], [[], -1, [1, -1]]),
        ({"kind": "number", "optional": True}, [None, 1], ["1"]),
        ({"kind": "table"}, [{}], [[]]),
        ({"kind": "own", "accepts": callable, "phrase": "a function"}, [len], [3]),
    ],
)
def test_kinds(options: dict[str, Any], good: list[Any], bad: list[Any]) -> None:
    one = Fact(doc="value", **options)
    assert [one.fault(value) for value in good] == [None] * len(good)
    assert None not in [one.fault(value) for value in bad]
    assert one.expected


def test_numbers_in_the_units_of_the_argument_stay_exact() -> None:
    keys = by_key([Fact(doc="length", kind="number", name="length", key="length_m", scale=1.0)])
    assert arguments_of(keys, {"length_m": 0.1234567890123456}) == {"length": 0.1234567890123456}
    assert isinstance(arguments_of(keys, {"length_m": 2})["length"], float)


def test_keys_have_the_units_of_the_file() -> None:
    exposure = Fact(
        doc="exposure", kind="number", name="exposure", key="exposure_ms", scale=1e-3, least=0.0, most=3600.0,
        default=5e-3,
    )  # fmt: skip
    key = by_key([exposure])["exposure_ms"]
    assert (key.default, key.most, key.argument(7)) == (5.0, 3.6e6, 0.007)
    assert "| `exposure_ms` | a number from 0 to 3.6e+06 | `5.0` | exposure |" in key_table(
        {"exposure_ms": key}
    )


def test_a_declared_class_documents_its_fields() -> None:
    @declared
    @dataclass
    class Lamp:
        """A lamp.

        Raises
        ------
        SchemaError
            Wrong.
        """

        power: float = fact(3.0, "radiant flux", unit="W", least=0)

        def __post_init__(self) -> None:
            problems = Problems("no lamp", SchemaError)
            check_fields(self, problems)
            problems.raise_if_any()

    assert Lamp.__doc__ == (
        "A lamp.\n\nAttributes\n----------\npower\n    Radiant flux [W]; a number from 0.\n\n"
        "Raises\n------\nSchemaError\n    Wrong."
    )
    expect_error(SchemaError, "value-out-of-range", lambda: Lamp(-1.0))


def test_pint_quantities_follow_from_the_facts() -> None:
    pint = pytest.importorskip("pint")
    assert SimulationSettings(exposure_time_ms=pint.Quantity(4.0, "ms")).exposure_time_ms == 4.0
    assert SimulationSettings(swath=pint.Quantity(16.0, "m")).swath == 16.0


def test_every_field_of_the_simulator_is_documented() -> None:
    for name in SimulationSettings.__dataclass_fields__:
        assert f"\n{name}\n    " in (SimulationSettings.__doc__ or ""), name


def test_shared_parameters_are_described() -> None:
    @documented(depth="Number of levels.", width="picture")
    def walk(depth: int, overwrite: bool, own: int, width: str, **kwargs: int) -> None:
        """Walk.

        Parameters
        ----------
        depth
        own
            Described here.
        overwrite
        width
        **kwargs

        Returns
        -------
        Nothing.
        """

    doc = walk.__doc__ or ""
    expect_words(
        doc,
        "depth\n    Number of levels.\nown\n    Described here.\noverwrite\n    Replace the output",
        f"\nwidth\n    {PARAMETERS['picture']}\n**kwargs\n    Passed to",
    )
    assert doc.endswith("\n\nReturns\n-------\nNothing.")


@pytest.mark.parametrize("page", PAGES)
def test_pages_have_the_keys_of_the_facts(page: str) -> None:
    assert (DOCS / page).read_text(encoding="utf-8") == with_tables(page)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *((value, True) for value in (np.array(0.04), xr.DataArray(37.25), np.float32(1.0))),
        *((value, False) for value in (np.array([0.04]), np.array(True), np.array("1"))),
    ],
)
def test_a_number_may_be_an_array_without_dims(value: Any, expected: bool) -> None:
    assert is_number(value) is expected
