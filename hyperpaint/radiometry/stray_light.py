r"""Stray light and smear between the bands of a column, and their removal.

Counts above dark, made linear, are :math:`s = (1 + \epsilon 1 1^T)(1 + D)\,c\,(1 + E)^T`: light scattered
between bands, D (band, source band) of a lab sweep, and between columns, E (column, source column), and the
smear of a detector whose frames are shifted during exposure, where a band receives
:math:`\epsilon = t_{shift} / t` of each other band. All are inverted as sums over bands or columns, D and E
by their largest singular values where few suffice, because scattered light is smooth.

Linearity of the detector: a polynomial or a table from raw counts to counts proportional to light.

Declared for dark-subtracted counts, c = L(C - D), or for raw counts, c = L(C) - L(D), depending on whether
amplifier and converter, which process light and dark, are nonlinear, or the detector wells.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import Array, Floats, Ints, Problems, SchemaError, one_of, require, warn_if
from hyperpaint.kernels.arguments import DetectorModel, StrayLight, StrayTerms

DARK_SUBTRACTED, RAW = "dark-subtracted", "raw"
TABLE = ("linearity_counts", "linear_counts")
#: Variables by which the curves of elements differ from the table.
OF_ELEMENTS = ("linearity_basis", "linearity_map")
CURVE = SimpleNamespace(
    #: Number of terms of a polynomial in the kernel; longer polynomials become tables.
    max_kernel_terms=4,
    #: Nodes of a table: every eighth count of 16 bits, so that interpolation of a curve with 5 % at full
    #: scale is accurate to 1e-5 counts.
    table_nodes=8192,
    #: Range of a table below 0, as a share of the highest count [1], which covers dark noise.
    below_dark_share=1.0 / 16.0,
    #: End of the curve [count] if the calibration has no saturation count.
    default_highest_count=65535.0,
)


class Pedestal(NamedTuple):
    # Pedestals of a line; ``masked``, ``groups`` and ``is_median`` as of `DetectorModel`.
    masked: Ints
    groups: Ints
    is_median: Any
    elements: float  #: Number of masked elements whose mean is as noisy as the pedestal; 0 without a pedestal


NO_PEDESTAL = Pedestal(np.empty((0, 2), np.int64), np.empty((0, 4), np.int64), np.bool_(False), 0.0)
#: Values of the attribute ``pedestal``: what each pedestal belongs to, in the order of subtraction.
PEDESTALS = {
    "line": ("line",),
    "band": ("band",),
    "column": ("column",),
    "band, column": ("band", "column"),
    "column, band": ("column", "band"),
}
#: Values of the attribute ``pedestal_statistic``, and the variance of each over that of a mean.
STATISTICS = {"mean": 1.0, "median": np.pi / 2.0}
#: Least number of masked elements of a band or column: the median of fewer follows a cosmic ray.
MIN_MASKED = 3


def declared_pedestal(attrs: Mapping[Any, Any]) -> tuple[str, str]:
    # Return the attributes ``pedestal`` and ``pedestal_statistic`` of a calibration or a line.
    #
    # Raises `SchemaError`: An attribute has an unknown value.
    pedestal, statistic = attrs.get("pedestal", "line"), attrs.get("pedestal_statistic", "mean")
    one_of(pedestal, PEDESTALS, "attribute pedestal")
    one_of(statistic, STATISTICS, "attribute pedestal_statistic")
    return pedestal, statistic


def pedestal_of(masked: Array, usable: Array, declared: tuple[str, str]) -> Pedestal:
    # Return the pedestals of lines by their ``masked`` and ``usable`` elements (band, column) bool.
    #
    # The pedestal of a line uses all masked elements, that of a band the columns that are masked in all
    # bands, that of a column the bands that are masked in all columns.
    #
    # Raises `SchemaError`: A band or column has too few masked elements.
    pedestal, statistic = declared
    numbers: Any = np.indices(masked.shape)
    parts = {
        "line": (-1, np.zeros_like(numbers[0]), masked, 0),
        "band": (0, numbers[0], masked & masked.all(axis=0), MIN_MASKED),
        "column": (1, numbers[1], masked & masked.all(axis=1, keepdims=True), MIN_MASKED),
    }
    elements, groups, variance, first = [], [], 0.0, 0
    for part in PEDESTALS[pedestal]:
        axis, label, is_used, least = parts[part]
        key = label[is_used & usable]
        number = np.bincount(key, minlength=int(label.max()) + 1)
        is_short = (number < least) & (np.bincount(label[usable], minlength=number.size) > 0)
        SchemaError.raise_if(
            is_short.any(),
            f"pedestal {pedestal!r}: {np.count_nonzero(is_short)} of {number.size} {part}s have fewer than "
            f"{least} elements in masked {'columns' if part == 'band' else 'bands'}",
            mend="compute reflectance of the whole line before cutting it, or set pedestal to 'line'",
            code="masked-few",
        )
        last = first + np.cumsum(number)
        groups.append(np.stack([last - number, last, np.full_like(last, axis), np.arange(last.size)], axis=1))
        elements.append(np.argwhere(is_used & usable)[np.argsort(key, kind="stable")])
        first = int(last[-1])
        variance += STATISTICS[statistic] / number[number > 0].min(initial=max(first, 1))
    return Pedestal(
        np.concatenate(elements).astype(np.int64),
        np.concatenate(groups).astype(np.int64),
        np.bool_(statistic == "median"),
        1.0 / variance if first else 0.0,
    )


@dataclass(frozen=True)
class Linearity:
    # Curve from counts to counts proportional to light; see `linearity_of`.
    coefficients: tuple[float, ...] = ()  #: a2, a3 ... of c + a2 c^2 + a3 c^3 + ...; none with a table
    #: measured, linear (node,) [count]: the table, linear between nodes and beyond them; None without a table
    measured: Any = None
    linear: Any = None
    on_raw: bool = False  #: Whether the curve applies to raw counts, which include the dark
    #: basis (term, node), weights (term, band, column) [1]: by their sum of products times the counts, linear
    #: between nodes, the linear counts of an element exceed the table; None where elements are alike
    basis: Any = None
    weights: Any = None

    def __bool__(self) -> bool:
        return bool(self.coefficients) or self.measured is not None

    def described(self, as_table: bool) -> str:
        # Return a description for an attribute; ``as_table``: the curve is a table that is not read yet.
        form = "table" if as_table else f"polynomial of degree {len(self.coefficients) + 1}"
        return f"{form} on {RAW if self.on_raw else DARK_SUBTRACTED} counts"

    def correction(self, counts: Any) -> Any:
        # Return the counts to add to counts of any shape to make them proportional to light [count].
        #
        # With weights of elements, counts are (..., band, column).
        if self.measured is not None:
            shared, *of_elements = self.rows_at(counts)
            return shared + sum(w * row for w, row in zip(self._weights, of_elements, strict=True))
        relative = 0.0
        for coefficient in reversed(self.coefficients):
            relative = (relative + coefficient) * counts
        return counts * relative

    @property
    def _weights(self) -> Floats:
        return np.empty((0, 1, 1)) if self.weights is None else self.weights

    def rows_at(self, counts: Any) -> Floats:
        # Return the correction of a table and its functions of elements (1 + term, ...) at counts [count].
        nodes = self.measured
        rows = (self.linear - nodes)[None]
        rows = rows if self.basis is None else np.concatenate([rows, nodes * self.basis])
        lower = np.clip(np.searchsorted(nodes, counts) - 1, 0, nodes.size - 2)
        rise = np.diff(rows) / np.diff(nodes)
        return np.asarray(rows[:, lower] + rise[:, lower] * (counts - nodes[lower]))

    def net(self, raw: Any, dark: Any) -> Any:
        # Return counts above dark, proportional to light; without a curve their difference, bit for bit.
        if not self:
            return raw - dark
        if self.on_raw:
            return (raw + self.correction(raw)) - (dark + self.correction(dark))
        net = raw - dark
        return net + self.correction(net)

    def detector_model(self, highest_count: float) -> DetectorModel:
        # Return the curve for the kernel: a short polynomial unchanged, any other curve as a fine table.
        polynomial, table = np.empty(0, np.float32), np.empty((0, 0), np.float32)
        nodes, per_count = np.zeros(1), 1.0
        if 0 < len(self.coefficients) <= CURVE.max_kernel_terms:
            polynomial = np.zeros(CURVE.max_kernel_terms, np.float32)
            polynomial[: len(self.coefficients)] = self.coefficients
        elif self:
            end = highest_count if np.isfinite(highest_count) else CURVE.default_highest_count
            nodes = np.linspace(-CURVE.below_dark_share * end, end, CURVE.table_nodes)
            if self.measured is None:
                table = np.asarray(self.correction(nodes), np.float32)[None]
            else:
                if np.ptp(np.diff(self.measured)) <= 1e-6 * np.ptp(self.measured) / self.measured.size:
                    nodes = self.measured  # evenly spaced: exact
                table = self.rows_at(nodes).astype(np.float32)
            per_count = (nodes.size - 1) / (nodes[-1] - nodes[0])
        return DetectorModel(
            polynomial,
            table,
            np.ascontiguousarray(self._weights, np.float32),
            np.float32(nodes[0]),
            np.float32(per_count),
            *NO_PEDESTAL[:3],
            np.bool_(bool(self) and self.on_raw),
        )

    def check(self, problems: Problems, highest_count: float) -> None:
        # Add problems of a curve that is not finite, or does not increase up to the highest count.
        if not self:
            return
        if self.measured is not None:
            tables = (self.measured, self.linear, 0.0 if self.basis is None else self.basis, self._weights)
            is_finite = all(np.isfinite(table).all() for table in tables)
            if self.measured.size < 2 or not is_finite or (np.diff(self.measured) <= 0).any():
                problems.add(
                    f"the table of linearity has {self.measured.size} counts from {self.measured[:1]} to "
                    f"{self.measured[-1:]}",
                    expected="two or more finite counts that increase, a finite basis and map",
                    code="linearity-invalid",
                )
                return
        end = highest_count if np.isfinite(highest_count) else CURVE.default_highest_count
        counts = np.linspace(0.0, end, 1025)
        rows = self.correction(counts)[None] if self.measured is None else self.rows_at(counts)
        rise = np.diff(counts + rows[0])
        for weight, row in zip(self._weights, rows[1:], strict=True):
            # few elements may be dead
            rise += np.minimum(*(share * np.diff(row) for share in np.percentile(weight, (1.0, 99.0))))
        problems.add_if(
            not (rise > 0).all(),
            f"linearity is not monotonic below {end:g} counts",
            expected="linear counts that rise with the counts",
            mend="fit it over the whole range, or with a lower degree",
            code="linearity-not-monotonic",
        )


def linearity_of(dataset: xr.Dataset) -> Linearity:
    # Return the curve that a calibration or a line declares.
    #
    # Attribute ``linearity``: coefficients of `hyperpaint.calibration.linearity`, or "identity"; the variable
    # ``linear_counts`` over ``linearity_counts`` in their place is a table, from which elements may differ by
    # ``linearity_basis`` and ``linearity_map``. Attribute ``linearity_on``:
    # "dark-subtracted", the default, or "raw".
    #
    # Raises `SchemaError`: The attribute or the table is invalid.
    declared = declared_linearity(dataset.attrs)
    names = table_names(dataset.variables)
    return tabulated(require(dataset, names, "linearity"), declared.on_raw) if names else declared


def table_names(names: Collection[Any]) -> tuple[str, ...]:
    # Return the variables of a table that one of ``names`` belongs to.
    has_table = TABLE[1] in names
    return (*TABLE, *OF_ELEMENTS) if {*OF_ELEMENTS} & {*names} else TABLE if has_table else ()


def tabulated(arrays: Mapping[str, Any], on_raw: bool) -> Linearity:
    # Return the curve of the variables of a table by name.
    measured, linear, *of_elements = (np.asarray(arrays[name]) for name in table_names(arrays))
    return Linearity((), measured.astype(np.float64), linear.astype(np.float64), on_raw, *of_elements)


def declared_linearity(attrs: Mapping[Any, Any]) -> Linearity:
    # Return the curve that attributes alone declare; see `linearity_of`.
    kind = attrs.get("linearity_on", DARK_SUBTRACTED)
    one_of(kind, (DARK_SUBTRACTED, RAW), "attribute linearity_on")
    declared = attrs.get("linearity", ())
    coefficients = () if isinstance(declared, str) else np.atleast_1d(np.asarray(declared, np.float64))
    numbers = tuple(float(value) for value in coefficients)
    SchemaError.raise_if(
        not np.isfinite(numbers).all(),
        f"linearity {numbers}",
        expected="finite coefficients a2, a3 ...",
        code="linearity-invalid",
    )
    return Linearity(numbers if any(numbers) else (), on_raw=kind == RAW)


# --- linearity ---------------------------------------------------------------------------------------------

#: Variables that declare stray light and smear, and the levels of elements.
STRAY, STRAY_U, SHIFT_TIME = "stray_light", "stray_light_u", "band_shift_time"
ACROSS, FLAT = "stray_light_across", "flat_field"
STRAY_LIGHT = (STRAY, STRAY_U, SHIFT_TIME, ACROSS, FLAT)
STRAY_SOURCES = {STRAY, SHIFT_TIME, ACROSS}
MATRIX = SimpleNamespace(
    #: Largest row sum of absolute values of the inverse [1]; above, most light would be stray.
    max_row_sum=10.0,
    #: Largest share of a frame's light that is smear [1]: bands times shift time over exposure.
    max_smear_share=0.5,
    #: Steps of the robust fit of levels: least absolute deviations, then least squares without outliers.
    level_steps=12,
    #: Largest row sum of absolute values of the truncated terms of D [1]. They alternate in sign, so that
    #: smooth spectra lose a hundredth of that.
    max_truncated=3e-4,
    pad=4,
)
#: Largest factor between the response of an element and the trend of its band by which levels are fitted [1].
MAX_LEVEL = 1.5
#: Smallest and largest residual by which levels are weighted, in the logarithm and in standard deviations.
_LEAST_RESIDUAL, _OUTLIER_SD = 1e-6, 5.0


def inverse_of(matrix: Floats, name: str) -> Floats:
    # Return :math:`(1 + D)^{-1}` (band, source band).
    #
    # Raises `SchemaError`: D is not finite, not square, or so large that most light would be stray.
    SchemaError.raise_if(
        matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix).all(),
        f"{name} has shape {matrix.shape}",
        expected="a finite square matrix over all bands",
        code="stray-matrix-shape",
    )
    try:
        inverse = np.linalg.inv(np.eye(len(matrix)) + matrix)
    except np.linalg.LinAlgError:
        inverse = np.full_like(matrix, np.inf)
    SchemaError.raise_if(
        not np.abs(inverse).sum(axis=1).max() < MATRIX.max_row_sum,
        f"{name} cannot be inverted, since most light would be stray",
        expected="shares far below 1",
        code="stray-matrix-singular",
    )
    return np.asarray(inverse)


def check_stray_light(
    cube: Mapping[str, Any], bands: int, columns: int, exposure: Floats, problems: Problems
) -> None:
    # Add problems of stray light that does not fit the bands of a cube, or is too large to subtract.
    of_bands = {STRAY: np.shape(cube.get(STRAY, 0.0)), SHIFT_TIME: (cube.get("shifted_bands") or bands,)}
    for name, declared in of_bands.items():
        problems.add_if(
            {*declared} - {bands},
            f"{name!r} belongs to {max(declared, default=0)} bands, this line has {bands}",
            mend="select bands after computing reflectance, or drop the variable",
            code="bands-selected",
        )
    problems.add_if(
        {*np.shape(cube.get(ACROSS, 0.0))} - {columns},
        f"{ACROSS!r} belongs to {max(np.shape(cube.get(ACROSS, 0.0)), default=0)} columns, this line has "
        f"{columns}",
        mend="select columns after computing reflectance, or drop the variable",
        code="columns-selected",
    )
    relative = float(cube.get(STRAY_U, 0.0))
    problems.add_if(
        not 0.0 <= relative < 1.0,
        f"{STRAY_U!r} is {relative:g}",
        expected="a fraction of 1, such as 0.1",
        code="value-out-of-range",
    )
    shift = float(cube.get(SHIFT_TIME, 0.0))
    problems.add_if(
        not 0.0 <= shift * bands <= MATRIX.max_smear_share * float(exposure.min()),
        f"{SHIFT_TIME!r} is {shift:g} s: times {bands} bands over {MATRIX.max_smear_share:.0%} of the "
        f"exposure of {exposure.min():g} s",
        expected="the time of one band, some microseconds",
        code="smear-implausible",
    )


def stray_light_of(cube: Mapping[str, Any], exposure: Floats, gain: Array, masked: Ints) -> StrayLight | None:
    # Return the terms of stray light to subtract from lines; None where the line declares none.
    #
    # ``exposure`` (line,) [s]; ``gain`` (band, column), NaN for bad elements, which are replaced by the
    # nearest good band of their column; ``masked`` (n, 2): band and column of elements that receive no light.
    #
    # Warns `PaintWarning`: Elements respond unlike their neighbours.
    if not STRAY_SOURCES & set(cube):
        return None
    level = np.array(cube[FLAT], np.float64) if FLAT in cube else _levels(gain)
    # column, band and replacement band of every bad element; -1 without a replacement
    is_bad, is_masked = np.isnan(gain), np.zeros(gain.shape, bool)
    is_masked[tuple(masked.T)] = True
    replacements = []
    for band, column in np.argwhere(is_bad):
        good_bands, nearest = np.flatnonzero(~is_bad[:, column]), -1
        if good_bands.size and not is_masked[band, column]:
            nearest = int(good_bands[np.argmin(np.abs(good_bands - band))])
        replacements.append((column, band, nearest))
        level[band, column] = level[nearest, column]
    return StrayLight(
        _terms(cube.get(STRAY, np.zeros((len(gain), len(gain)))), STRAY),
        _terms(cube[ACROSS], ACROSS) if ACROSS in cube else None,
        smear_of(float(cube.get(SHIFT_TIME, 0.0)), exposure, len(gain)).astype(np.float32),
        np.array(replacements, np.int64).reshape(-1, 3),
        np.asarray(np.where(level > 0.0, level, 1.0), np.float32),
        np.float32(cube.get(STRAY_U, 0.0)),
    )


def _levels(gain: Array) -> Floats:
    # Return gains (band, column) relative to their trend along the columns, a parabola, which is caused by
    # smile, and so belongs to the light; NaN for bad elements.
    #
    # The parabola is fitted to logarithms by least absolute deviations, in weighted steps, and then by least
    # squares without outliers, so that weak elements do not change it. Elements far off the medians of their
    # band and column are left out of the first fits: many beside one another would bend the parabola.
    terms = np.linspace(-1.0, 1.0, gain.shape[1])[:, None] ** np.arange(3)
    products = (terms[:, :, None] * terms[:, None]).reshape(-1, 9)
    is_finite = np.isfinite(gain)
    values = np.log(np.where(is_finite, gain, 1.0).astype(np.float64))
    values -= _row_medians(values, is_finite)
    residual = values - _row_medians(values.T, is_finite.T).T
    is_fitted = is_finite & (np.abs(residual) <= np.log(MAX_LEVEL))
    weight = is_fitted.astype(np.float64)
    for step in range(MATRIX.level_steps):
        normal = np.linalg.pinv((weight @ products).reshape(-1, 3, 3), 1e-10)
        parabola = normal @ ((weight * values) @ terms)[:, :, None]
        residual = values - parabola[:, :, 0] @ terms.T
        size = np.abs(residual)
        if step < MATRIX.level_steps - 2:
            weight = is_fitted / np.maximum(size, _LEAST_RESIDUAL)
        else:
            limit = _OUTLIER_SD * 1.4826 * _row_medians(size, is_finite) + _LEAST_RESIDUAL
            weight = (is_finite & (size <= limit)).astype(np.float64)
    n_weak = np.count_nonzero(is_finite & (np.abs(residual) > np.log(MAX_LEVEL)))
    warn_if(
        n_weak,
        f"{n_weak} elements respond over {MAX_LEVEL:g} times less or more than their neighbours: they do "
        "not enter the fitted levels of elements by which stray light is subtracted; mark dead elements "
        "by a gain of NaN, or declare flat_field",
        "elements-weak",
    )
    return np.where(is_finite, np.exp(residual), np.nan)


def _row_medians(values: Floats, used: Array) -> Floats:
    # Return the medians of rows over the used values, or over all where none is used (row, 1).
    is_counted = used | ~used.any(axis=1, keepdims=True)
    return np.asarray(np.nanmedian(np.where(is_counted, values, np.nan), axis=1, keepdims=True))


def _terms(matrix: Any, name: str) -> StrayTerms:
    # Return `1 - (1 + D)^{-1}` of a declared matrix as a product (out, term), (term, source), of the fewest
    # sufficient terms, or unchanged where these would need more sums.
    share = np.eye(len(matrix)) - inverse_of(np.asarray(matrix, np.float64), name)
    left, size, right = np.linalg.svd(share)
    residual = share.copy()
    for term in range(0, len(size) // 2, MATRIX.pad):
        if np.abs(residual).sum(axis=1).max() <= MATRIX.max_truncated:
            return StrayTerms(_padded(left[:, :term] * size[:term]), _padded(right[:term]))
        next_terms = slice(term, term + MATRIX.pad)
        residual -= (left[:, next_terms] * size[next_terms]) @ right[next_terms]
    return StrayTerms(None, _padded(share))


def smear_of(shift_time: float, exposure: Any, bands: int) -> Any:
    # Return the smear of each band as a share of the sum of all, :math:`\epsilon / (1 + n \epsilon)` [1].
    #
    # ``shift_time`` and ``exposure``, of any shape, in seconds.
    share = shift_time / exposure
    return np.asarray(share / (1.0 + share * bands))


def described(cube: Mapping[Any, Any]) -> str | None:
    # Return the description of the subtracted light for an attribute; None for nothing.
    descriptions = {
        STRAY: "scattered light by the matrix of the calibration",
        ACROSS: "light scattered between columns",
        SHIFT_TIME: "smear by the time in which a frame is shifted",
    }
    return ", ".join(text for name, text in descriptions.items() if name in cube) or None


def _padded(values: Array) -> Array:
    # Return a matrix with zeros appended to its rows, up to a multiple of `MATRIX.pad`.
    return np.ascontiguousarray(np.pad(values, ((0, 0), (0, -values.shape[1] % MATRIX.pad))), np.float32)
