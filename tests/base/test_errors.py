"""Errors a user can catch by what they are, and that name everything at once."""

import pickle

from support.refusals import expect_error

import hyperpaint
from hyperpaint.base import errors


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
