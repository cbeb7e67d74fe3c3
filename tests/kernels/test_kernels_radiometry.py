"""The slab kernel against plain numpy, in every mode; with compilation and without."""

from typing import Any

import numpy as np
import pytest
from support.slab_arguments import calibrate, oracle, problem, round_values

from hyperpaint.kernels.arguments import SlabOutputs


def run(p: dict[str, Any], dropped: int = 0, flagging: bool = True) -> tuple[np.ndarray, np.ndarray]:
    shape = p["counts"].shape
    out = np.full(shape, 77, np.float32)
    quality = np.full((shape[0], shape[2]) if flagging else (0, 0), 9999, np.uint16)
    cube = np.empty((0, 0, 0), np.float32)
    calibrate(p, SlabOutputs(out, quality, cube, cube), dropped)
    return out, quality


@pytest.mark.parametrize("own_limit", [False, True], ids=["one limit", "own limits"])
@pytest.mark.parametrize("darks", [1, 3])
@pytest.mark.parametrize("smile", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_against_plain_numpy(dtype: Any, smile: int, darks: int, own_limit: bool) -> None:
    p = problem(dtype, smile=smile, darks=darks, own_limit=own_limit)
    before = {name: value.copy() for name, value in p.items()}
    expected, flags = oracle(p)
    out, quality = run(p)
    assert {1, 2, 4, 8, 32} <= {bit for bit in (1, 2, 4, 8, 32) if (flags & bit).any()}
    np.testing.assert_allclose(out, expected, rtol=3e-6, atol=1e-10)
    np.testing.assert_array_equal(quality, flags)
    for name, value in p.items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@pytest.mark.parametrize("smile", [0, 1])
def test_no_bit_depends_on_the_number_of_lines(smile: int) -> None:
    p = problem(np.uint16, smile=smile, darks=3)
    whole, quality = run(p, dropped=11)
    for line in range(7):
        part = dict(p)
        for name in ("counts", "dark_index", "dark_weight", "light", "line_flags"):
            part[name] = p[name][line : line + 1]
        out, flags = run(part, dropped=11)
        assert out.tobytes() == whole[line : line + 1].tobytes()
        np.testing.assert_array_equal(flags[0], quality[line])


def test_without_quality_nothing_else_changes() -> None:
    p = problem(np.uint16)
    np.testing.assert_array_equal(run(p)[0], run(p, flagging=False)[0])


def test_missing_counts_hide_no_saturation() -> None:
    p = problem(np.float32)
    p["counts"][:] = 500.0
    p["counts"][0, 3, 6] = 4090.0
    p["counts"][0, 4:, 6] = np.nan
    p["counts"][1, 0, 7] = np.nan
    p["counts"][1, 3, 7] = 4090.0
    out, quality = run(p)
    np.testing.assert_array_equal(np.argwhere(quality & 1), [[0, 6], [1, 7]])
    assert np.isnan(out[0, 4:, 6]).all()


@pytest.mark.parametrize("keep", [1, 7, 12, 20, 22, 23])
def test_rounding_is_that_of_numcodecs(keep: int) -> None:
    codec = pytest.importorskip("numcodecs").BitRound(keepbits=keep)
    rng = np.random.default_rng(2)
    values = rng.normal(size=(3, 4, 50)).astype(np.float32) * 10.0 ** rng.integers(-30, 30, (3, 4, 50))
    values = values.astype(np.float32)
    values[0, 0, :6] = [0.0, -0.0, np.inf, -np.inf, 1.0, np.float32(1 + 2**-12)]
    expected = np.frombuffer(codec.encode(values.copy()), np.float32).reshape(values.shape)
    made = values.copy()
    if keep < 23:
        round_values(made, 23 - keep)
    np.testing.assert_array_equal(made.view(np.uint32), expected.view(np.uint32))


def test_rounding_leaves_nan_missing() -> None:
    values = np.full((1, 1, 4), np.nan, np.float32)
    round_values(values, 11)
    assert np.isnan(values).all()


def test_rounding_inside_the_slab_is_the_same() -> None:
    p = problem(np.uint16)
    plain = run(p)[0]
    round_values(plain, 11)
    assert plain.tobytes() == run(p, dropped=11)[0].tobytes()
