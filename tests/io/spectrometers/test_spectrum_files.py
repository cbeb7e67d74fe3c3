"""What readers of field spectrometers share."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.refusals import expect_refusals

from hyperpaint.base.errors import FormatError
from hyperpaint.io.spectrometers.spectrum_files import find_paths, for_all, name_spectra, same_grids

NAMES = st.sampled_from(["red", "red (2)", "blue", "a/red", ""])


@given(st.lists(st.tuples(st.sampled_from(["a/x.sig", "b/x.sig", "x.sig", "/x.sig"]), NAMES)))
def test_names_are_unique_and_plain_where_they_can_be(sources) -> None:
    made = name_spectra([(Path(path), name) for path, name in sources])
    assert len(set(made)) == len(made) == len(sources)
    given_names = [name for _, name in sources]
    for (_, name), unique in zip(sources, made, strict=True):
        assert name in unique
        if given_names.count(name) == 1 and made.count(name):
            assert unique.startswith(name)


def test_grids_are_the_same_to_the_last_bit() -> None:
    grid = np.array([400.0, 401.0])
    found = same_grids([("a", grid), ("b", np.nextafter(grid, 0)), ("c", grid.copy())])
    assert [names for _, names in found] == [["a", "c"], ["b"]]


def test_one_error_for_all_with_each_reason_once() -> None:
    def read(name: str) -> str:
        if name == "good":
            return name
        raise FormatError(f"{name}: truncated: at 3", code="file-truncated")

    assert for_all(["good"], read) == ["good"]
    with pytest.raises(FormatError) as caught:
        for_all(["a", "good", "b"], read)
    assert caught.value.codes == ("file-truncated",)
    assert caught.value.problem.found == "spectra cannot be used"
    assert caught.value.problems[0].found == "a, b: truncated: at 3"


def test_files_folders_globs_and_lists(tmp_path) -> None:
    for name in ("b.sig", "a.sig", ".hidden.sig", "c.txt", "sub/d.sig"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()

    def find(paths):
        found = find_paths(paths, lambda inside: [p for p in inside if p.suffix == ".sig"], ".sig files")
        return [path.name for path in found]

    assert find(tmp_path) == ["a.sig", "b.sig"]
    assert find([tmp_path / "c.txt", str(tmp_path / "**" / "*.sig")]) == ["c.txt", "a.sig", "b.sig", "d.sig"]
    assert find(tmp_path / "gone.sig") == ["gone.sig"]  # to read it is the error that names it
    expect_refusals(
        (FormatError, "file-not-found", lambda: find([str(tmp_path / "one*"), str(tmp_path / "two*")])),
        (FormatError, "empty-input", lambda: find([])),
    )
