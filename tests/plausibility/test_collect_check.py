"""Collects that cannot be true, from the file to the refusal and on."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from campaigns import judged_collects
from click.testing import CliRunner
from support.plausible_collects import FAULTS, RECIPES, right_collect, wrong_collect
from support.refusals import expect_errors, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, PaintWarning, SchemaError
from hyperpaint.cli.program import main
from hyperpaint.io.store import open_store
from hyperpaint.plausibility import KINDS, Finding
from hyperpaint.plausibility.judging import judge_irradiance, judge_navigation, mean_dark
from hyperpaint.simulation import simulate_collect
from hyperpaint.workflows.collects import check_collect
from hyperpaint.workflows.pipeline import process


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    simulate_collect(folder, scene="plan", lines=40, bands=40, columns=24, seed=3, truth=False)
    return folder


@pytest.fixture
def collect(flown: Path, tmp_path: Path) -> Path:
    return shutil.copytree(flown, tmp_path / "collect") / "collect.toml"


def _change(cube: Path, change: object) -> None:
    counts = np.fromfile(cube, "<u2")
    np.asarray(change(counts), "<u2").tofile(cube)  # type: ignore[operator]


def test_all_findings_are_shown_at_once(collect: Path) -> None:
    assert CliRunner().invoke(main, ["check", str(collect)]).output.endswith("judgements passed\n")
    _change(collect.parent / "flight/raw_0", lambda counts: counts * 16)
    _change(collect.parent / "dark/raw_0", np.zeros_like)
    done = CliRunner().invoke(main, ["check", str(collect)])
    assert done.exit_code == 1
    expect_words(
        done.output,
        "[counts-over-range]",
        "multiples of 16: left-justified, above 4095",
        "raw_0: 100 % of the dark",
    )


def test_what_cannot_be_true_is_not_processed_unless_accepted(collect: Path, tmp_path: Path) -> None:
    _change(collect.parent / "dark/raw_0", np.zeros_like)
    assert [finding.kind.name for finding in check_collect(collect)] == ["dark-of-zeros"]
    expect_errors(
        (
            CollectError,
            r"accept=.*dark-of-zeros",
            lambda: process(collect, tmp_path / "lot.zarr", reflectance="none"),
        )
    )
    assert not (tmp_path / "lot.zarr").exists()
    call = ["process", str(collect), "--out", str(tmp_path / "lot.zarr"), "--quiet"]
    refused = CliRunner().invoke(main, call)
    assert refused.exit_code == 2
    assert "--accept dark-of-zeros" in refused.output
    assert CliRunner().invoke(main, [*call, "--accept", "dark-of-zeros"]).exit_code == 0


def test_a_status_word_in_the_picture_is_no_reason_to_refuse(collect: Path, tmp_path: Path) -> None:
    def stamped(counts: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        counts[3 :: 40 * 24] = 65535
        return counts

    _change(collect.parent / "flight/raw_0", stamped)
    (finding,) = check_collect(collect)
    assert finding.kind.name == "stray-counts"
    assert not finding.kind.refused


@pytest.mark.parametrize(
    ("band", "column", "step", "modulus"),
    [(0, 0, 97, 4096), (0, 1, 1, 4096), (3, 23, 7, 512), (5, 0, -3, 2000)],
)
def test_a_frame_counter_in_the_picture_is_named(
    collect: Path, band: int, column: int, step: int, modulus: int
) -> None:
    def stamped(counts: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        frames = counts.reshape(40, 40, 24)
        frames[:, band, column] = np.arange(40) * step % modulus
        return frames

    _change(collect.parent / "flight/raw_0", stamped)
    (finding,) = (each for each in check_collect(collect) if each.kind.name == "frame-counter")
    assert f"band {band} of column {column}" in finding.found


def test_a_fore_optic_in_the_files_is_named(collect: Path, tmp_path: Path) -> None:
    for path in (collect.parent / "asd").glob("*.asd"):
        data = bytearray(path.read_bytes())
        data[394:396] = (25).to_bytes(2, "little")
        path.write_bytes(data)
    with pytest.warns(PaintWarning, match="fore-optic-wrong"):
        (finding,) = check_collect(collect)
    assert (finding.kind.name, finding.found) == ("irradiance-receptor", "fore optic of 25 degree")


def test_a_band_of_status_words_is_no_order_of_bytes(collect: Path) -> None:
    def stamped(counts: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        # light that hardly varies, so that the words are all that the picture shows
        frames = counts.reshape(40, 40, 24) // 64 + 400
        frames[:, 5] = 65000
        return frames

    _change(collect.parent / "flight/raw_0", stamped)
    findings = check_collect(collect)
    expect_words({each.kind.name for each in findings}, "counts-over-range", without=("byte-order",))


def test_counts_of_one_value_are_not_called_left_justified(collect: Path) -> None:
    _change(collect.parent / "flight/raw_0", lambda counts: counts * 0 + 65000)
    (found,) = (each.found for each in check_collect(collect) if each.kind.name == "counts-over-range")
    assert found == "counts up to 65000, above 4095 in 100 % of the elements"


def test_a_record_of_zeros_is_no_daylight(collect: Path) -> None:
    line = hp.open_collect(collect)["flightlines/raw_0"].to_dataset()
    (finding,) = judge_irradiance("raw_0", line.assign(irradiance=line["irradiance"] * np.nan))
    assert finding.kind.name == "irradiance-level"
    assert "zero or undefined" in finding.found


def test_a_record_that_stands_still_matters_to_reflectance_only(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = Finding(KINDS["irradiance-constant"], "raw_0", "2 of 2 spectra", "spectra that differ")
    monkeypatch.setattr("hyperpaint.plausibility.judging.judge_irradiance", lambda *_: iter([still]))
    expect_errors(
        (
            CollectError,
            "irradiance-constant",
            lambda: process(collect, tmp_path / "lot.zarr", reflectance="none"),
        )
    )
    process(collect, tmp_path / "lot.zarr", to="radiance", reflectance="none")


def test_darks_of_other_exposures_are_judged_as_they_are_used(collect: Path) -> None:
    # Bias and rate are fitted to darks before and after at other exposures; their mean is no dark
    line = hp.open_collect(collect)["flightlines/raw_0"].to_dataset()
    dark, exposure = line["dark_counts"].squeeze(drop=True), float(line["exposure_time"].mean())
    bias = dark.transpose("band", "cross_track").values.astype(float)
    factors = np.array([0.5, 10.0, 50.0])
    darks = bias + (factors[:, None, None] - 1.0) * 0.05 * bias
    several = line.drop_vars(["dark_counts", "dark_time", "dark_exposure_time"], errors="ignore").assign(
        dark_counts=(("dark_time", "band", "cross_track"), darks.astype("float32")),
        dark_exposure_time=("dark_time", factors * exposure),
    )
    found, is_measured = mean_dark(several)
    np.testing.assert_allclose(found, bias, rtol=1e-4)
    assert not is_measured
    assert mean_dark(line)[1]


def test_a_cube_that_lost_its_first_frame_or_its_name_is_only_said(collect: Path) -> None:
    flight = collect.parent / "flight"
    for ending in ("", ".hdr"):
        (flight / f"raw_0{ending}").rename(flight / f"raw_7{ending}")
    collect.write_text(collect.read_text().replace("flight/raw_0", "flight/raw_7"))
    assert {each.kind.name for each in check_collect(collect)} == {"first-frame"}


@pytest.mark.parametrize(("lost", "alarm"), [(("roll", "pitch", "heading"), False), (("latitude",), True)])
def test_angles_that_nothing_measured_are_no_gap(lost: tuple[str, ...], alarm: bool, collect: Path) -> None:
    line = hp.open_collect(collect)["flightlines/raw_0"].to_dataset()
    without = line.assign_coords({key: line[key] * np.nan for key in lost})
    assert bool([*judge_navigation("raw_0", without)]) is alarm


def test_a_name_of_no_finding_is_refused(collect: Path, tmp_path: Path) -> None:
    expect_errors(
        (SchemaError, "accept='all'", lambda: process(collect, tmp_path / "lot.zarr", accept=["all"]))
    )


def test_every_finding_is_listed() -> None:
    done = CliRunner().invoke(main, ["check", "--list"])
    assert done.exit_code == 0
    assert all(f"{name}  (" in done.output for name in KINDS)


def test_what_was_accepted_stands_in_the_store(collect: Path, tmp_path: Path) -> None:
    _change(collect.parent / "dark/raw_0", np.zeros_like)
    process(collect, tmp_path / "lot.zarr", reflectance="none", accept=["dark-of-zeros"])
    line = open_store(tmp_path / "lot.zarr", "flightlines/raw_0")
    assert "100 % of the dark" in line.attrs["accepted_findings"][0]


def test_a_flag_on_many_pixels_is_said(collect: Path, tmp_path: Path) -> None:
    def clipped(counts: np.ndarray) -> np.ndarray:
        columns = counts.reshape(40, 40, 24)
        columns[..., :8] = 4095
        return columns

    _change(collect.parent / "flight/raw_0", clipped)
    with pytest.warns(PaintWarning, match="33 % saturated"):
        process(collect, tmp_path / "lot.zarr", reflectance="none")


# --- A thinned round of the campaign of wrong and right collects ---

UNSEEN = {"lost frames, by the picture"}  # no promise: an edge of a field across the track looks the same


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # One collect for all faults; the campaign draws one for each
    folder = tmp_path_factory.mktemp("right") / "c"
    simulate_collect(
        folder, scene="plan", truth=False, seed=17, lines=160, bands=90, columns=40, irradiance_noise=0.002
    )
    return folder


@pytest.mark.parametrize("number", range(len(FAULTS)))
def test_every_fault_is_named(number: int, right: Path, tmp_path: Path) -> None:
    fault, strength = list(FAULTS)[number], number % 3
    texts = judged_collects.said_of(
        wrong_collect(tmp_path / "c", fault, strength, 17, right), whole=fault == "flagged pixels"
    )
    assert judged_collects.is_named(fault, texts) or fault in UNSEEN, texts


@pytest.mark.campaign
@pytest.mark.parametrize("kind", [kind for kind in RECIPES if kind != "traced"])
def test_right_ones_pass_without_a_word(kind: str, tmp_path: Path) -> None:
    assert judged_collects.said_of(right_collect(tmp_path / "c", kind, seed=17)) == []


@pytest.mark.real_data
def test_real_files_pass_without_a_word(shared_data: Path) -> None:
    said = judged_collects.judge_real(shared_data)
    assert len(said) == 14
    assert not any(said.values()), said
