"""Compare camera and irradiance record of a flight line, and correct significant differences."""

from __future__ import annotations

import warnings

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.constants import ALIGNMENTS, Alignment
from hyperpaint.base.errors import PaintError, PaintWarning, SchemaError
from hyperpaint.base.schema import CROSS_TRACK, IRRADIANCE_WAVELENGTH

from .application import restated, without_products
from .comparison import COMPARISON, Comparison, ComparisonRules, compared
from .sunlines import Instruments, divided

_OXYGEN_NM, _BLUE_NM = 760.0, 450.0
#: Upper end of the silicon detector of field spectrometers [nm]; results below do not hold for others.
VNIR_END_NM = 1000.0


def align(
    line: xr.Dataset,
    *,
    apply: Alignment = "auto",
    rules: ComparisonRules = COMPARISON,
) -> xr.Dataset:
    r"""Compare camera and irradiance record in flight, and correct significant differences.

    Eager, except for the cubes: 128 lines are read, evenly over the line; the same whatever the chunks.

    Parameters
    ----------
    line
        A flight line with the variables that `hyperpaint.reflectance` needs.
    apply
        ``"auto"``: correct where camera and record differ significantly, and irradiance changes enough to
        matter (``significance`` and ``least_effect`` of the rules). ``"never"``: report only. ``"always"``:
        correct any difference.
    rules
        Thresholds of the comparison.

    Returns
    -------
    Dataset
        The line; cubes stay lazy. Where a correction is applied, ``irradiance_wavelength`` and
        ``irradiance_fwhm`` are corrected, ``wavelength_shift`` holds the camera's share where that is
        significant (``camera_significance``), and reflectance, which held for other wavelengths, is removed.
        Channels of detectors beyond 1000 nm, which the comparison does not cover, keep their declared widths.
        The attributes:

        * ``alignment``: a sentence, after those of earlier corrections; ``alignment_state``: ``"applied"``,
          ``"not significant"``, ``"not applied"`` or ``"not compared"``.
        * ``alignment_shift``, ``alignment_shift_slope``: wavelength of the camera minus wavelength of the
        record,
          relative to their declarations, at 600 nm [nm], and its change over 100 nm [nm];
          ``alignment_width``: width of the record over the declared one [1], if all of it is the record's.
          Each with ``_u``.
        * ``alignment_departure``: joint departure of these from agreement, in standard uncertainties;
          ``alignment_effect``: largest relative change of irradiance [1].
        * ``alignment_residual``, ``alignment_residual_declared``: rms of the light's structure left in
        radiance
          over irradiance on average, relative, corrected and as declared [1].
        * ``alignment_record_shift``, ``alignment_camera_shift`` [nm], ``alignment_record_fwhm`` [nm],
          ``alignment_camera_width`` [1]: the share of each instrument, by the solar lines in the record.
          Each with ``_u``.

    Raises
    ------
    SchemaError
        ``apply`` is another word.

    Warns
    -----
    PaintWarning
        Camera and record differ, and it was not to be applied, or is beyond the search.

    Notes
    -----
    With :math:`\bar L_{bg}` the mean radiance of a band over the pixels of a group (columns and lines beside
    each other) and :math:`\bar E_b` the record's mean, shift :math:`\delta(\lambda)`, a straight line, and
    the record's width :math:`w` minimise

    .. math:: \sum_{g, b} \frac{1}{\sigma_g^2}
              \big( (1 - P) \ln (\bar L_{bg} / \bar E_b(\delta, w)) \big)^2

    over the windows of the rules, in which :math:`P` projects onto polynomials. Surfaces differ between
    groups: their scatter, and that between bands, is the uncertainty.

    Only the difference of the two affects reflectance. Solar lines in the record attribute it to one of them,
    with much larger uncertainty; the camera's ``wavelength_shift`` takes its share where that is significant,
    the record the rest. A record that is wider than declared and a camera that is narrower look alike; the
    record, whose width is seldom measured, takes the correction.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, columns=32, smile_nm=0.0, irradiance_fwhm_nm=4.0)
    >>> line["irradiance_fwhm"] = line.irradiance_fwhm - 1.0
    >>> aligned = align(line.assign_coords(irradiance_wavelength=line.irradiance_wavelength - 0.3))
    >>> aligned.attrs["alignment_state"], round(aligned.attrs["alignment_shift"], 1)
    ('applied', -0.3)
    """
    if apply not in ALIGNMENTS:
        raise SchemaError(
            f"apply={apply!r}", expected=f"one of {', '.join(map(repr, ALIGNMENTS))}", code="choice-unknown"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PaintWarning)  # computing the line itself warns
            comparison = compared(line, rules)
    except (PaintError, OSError) as error:  # processing of the line itself raises it
        return _not_compared(line, str(error).splitlines()[0])
    if comparison is None:
        return _not_compared(line, "too few bands, pixels or channels where daylight has lines")
    numbers = _numbers(comparison)
    is_significant = comparison.is_significant(rules)
    if comparison.at_limit:
        text = f"camera and irradiance record differ by more than can be corrected ({_sentence(comparison)})"
        warning = PaintWarning(f"{text}; check wavelengths and widths of both", code="alignment-at-limit")
        warnings.warn(warning, stacklevel=2)
        return restated(line, text, numbers=numbers, state="not applied")
    if apply == "always" or (apply == "auto" and is_significant):
        # the camera's wavelengths move only where its share is significant
        parts = _instruments(comparison)
        is_camera = abs(parts.camera_shift) > rules.camera_significance * parts.camera_shift_u
        camera = float(f"{parts.camera_shift:.3f}") if is_camera else 0.0
        moved = f", and the camera's wavelength_shift by {camera:+.3f} nm" if camera else ""
        text = f"irradiance record corrected in flight{moved}: {_sentence(comparison)}"
        return restated(_corrected(line, comparison, camera), text, numbers=numbers, state="applied")
    if is_significant:
        text = f"camera and irradiance record differ: {_sentence(comparison)}"
        mend = (
            "correct fwhm_nm and wavelengths of the collect, or correct them automatically: "
            "hp.alignment.align(line) in Python, --alignment auto on the command line, "
            '[alignment] apply = "auto" in collect.toml'
        )
        warnings.warn(PaintWarning(f"{text}; {mend}", code="alignment-differs"), stacklevel=2)
        return restated(line, text, numbers=numbers, state="not applied")
    text = f"camera and irradiance record agree: {_sentence(comparison)}"
    return restated(line, text, numbers=numbers, state="not significant")


def _not_compared(line: xr.Dataset, reason: str) -> xr.Dataset:
    return restated(line, f"camera and irradiance record not compared: {reason}", state="not compared")


def _numbers(found: Comparison) -> dict[str, float]:
    spread = np.sqrt(np.diag(found.covariance))
    values = {
        "shift": found.shift,
        "shift_u": spread[0],
        "shift_slope": found.tilt,
        "shift_slope_u": spread[1],
        "width": found.width,
        "width_u": spread[2],
        "effect": np.nanmax(np.abs(found.effect)),
        "departure": found.departure,
        "residual": found.residual,
        "residual_declared": found.residual_declared,
    }
    values |= _instruments(found)._asdict()
    return {f"alignment_{name}": float(f"{value:.6g}") for name, value in values.items()}


def _instruments(found: Comparison) -> Instruments:
    spread = np.sqrt(np.diag(found.covariance))
    shift, width = (found.shift, float(spread[0])), (found.width, float(spread[2]))
    return divided(shift, width, found.sun, found.declared_fwhm)


def _sentence(found: Comparison) -> str:
    spread = np.sqrt(np.diag(found.covariance))
    places = ", ".join(
        f"{float(found.effect[near]):+.2%} at {found.wavelength[near]:.0f} nm"
        for near in (int(np.abs(found.wavelength - nm).argmin()) for nm in (_BLUE_NM, _OXYGEN_NM))
    )
    return (
        f"camera minus record {found.shift:+.3f} +- {spread[0]:.3f} nm at 600 nm, changing by "
        f"{found.tilt:+.3f} +- {spread[1]:.3f} nm over 100 nm; width of the record {found.width:.3f} +- "
        f"{spread[2]:.3f} of that declared; irradiance changes by {places}, at most "
        f"{np.nanmax(np.abs(found.effect)):.2%}"
    )


def _corrected(line: xr.Dataset, found: Comparison, camera: float) -> xr.Dataset:
    # Line with corrected channels of the record; `camera`: the camera's share [nm]
    dataset = schema.rename_to_roles(line)
    arrays = schema.require(dataset, [IRRADIANCE_WAVELENGTH, "irradiance_fwhm"], "the alignment")
    channels = arrays[IRRADIANCE_WAVELENGTH].values.astype(np.float64)
    # the shift is constant beyond the compared bands
    reached = np.clip(channels, found.wavelength.min(), found.wavelength.max())
    shifted = channels - found.shift_at(reached) + camera
    width = np.broadcast_to(arrays["irradiance_fwhm"].values, channels.shape)
    same_detector = channels <= max(VNIR_END_NM, found.wavelength.max())
    widths = xr.DataArray(np.where(same_detector, width * found.width, width), dims=IRRADIANCE_WAVELENGTH)
    coordinate = xr.DataArray(shifted, dims=IRRADIANCE_WAVELENGTH)
    aligned = (
        without_products(dataset)
        .drop_vars("irradiance_fwhm")
        .assign_coords({IRRADIANCE_WAVELENGTH: schema.label(coordinate, IRRADIANCE_WAVELENGTH)})
    )
    if camera:
        # the columns' wavelengths move; ``wavelength`` stays, the axis of all lines
        names = [name for name in ("wavelength_shift",) if name in aligned.variables]
        declared = schema.require(aligned, names, "the alignment")
        zero = xr.DataArray(np.zeros(aligned.sizes[CROSS_TRACK]), dims=CROSS_TRACK)
        shift = declared.get("wavelength_shift", zero) + camera
        plain = xr.DataArray(shift.values, dims=shift.dims)
        aligned = aligned.assign_coords(wavelength_shift=schema.label(plain, "wavelength_shift"))
    return aligned.assign(irradiance_fwhm=schema.label(widths, "irradiance_fwhm"))
