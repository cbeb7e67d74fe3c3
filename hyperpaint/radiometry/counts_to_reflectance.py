"""Counts to radiance to reflectance.

    L   = radiance_gain (counts - dark) / exposure_time
    rho = pi L / E

Both are lazy: one task a slab of lines, one pass over memory.
"""

from collections.abc import Sequence
from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import takes_quantities
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    flags_set_from,
    label,
    rename_to_roles,
    require,
)
from hyperpaint.light.illumination import Tilt
from hyperpaint.light.synchrony import replace_record

from . import slabs
from .linear_counts import TABLE, Linearity
from .panels import (
    CLOSURE,
    Panel,
    closure_variables,
    declared_panels,
    declared_scale,
    panel_inputs,
    several_panels,
    without_panels,
)
from .planning import COUNTED, cube_inputs, has_white, lazy_plan, make_plan, plan_inputs, refuse_calibration
from .stray_light import described
from .uncertainty.propagation import UNCERTAINTIES, with_uncertainty
from .white_tiles import WHITE_ATTRS, WHITE_VARIABLES, white_reference

#: Bits that every product derives anew; bits of other rooms stay.
_PRODUCT_BITS = {"radiance": flags_set_from("counts"), "reflectance": flags_set_from("counts", "light")}


@takes_quantities()
def radiance(dataset: xr.Dataset) -> xr.Dataset:
    r"""Spectral radiance at the sensor, from raw counts.

    Lazy: one task a slab of lines, no pixel is read.

    Parameters
    ----------
    dataset
        A flight line: ``counts`` (along_track, band, cross_track), ``dark_counts`` and ``radiance_gain``
        (band, cross_track), ``exposure_time`` and ``saturation_count``, each with ``units``.

    Returns
    -------
    Dataset
        The line with ``radiance`` (along_track, band, cross_track), float32 [W m-2 sr-1 nm-1], and
        ``quality`` (along_track, cross_track), uint16. Saturated samples and bad elements are NaN.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, or have other dims or units; every problem is listed. The gain has
        no absolute scale (attribute ``absolute_scale`` of the calibration), or ``linearity_on`` is unknown.
        When computed: values are out of range, such as a dark at another exposure or a linearity curve that
        is not monotonic.

    Notes
    -----
    .. math:: L = g\,\ell(C - D) / t \quad\text{or}\quad L = g\,(\ell(C) - \ell(D)) / t

    with :math:`g` the radiance gain, :math:`C` and :math:`D` the counts and the dark, :math:`t` the
    exposure time and :math:`\ell` the detector's linearity, as the calibration declares it (attributes
    ``linearity`` and ``linearity_on``, or the table ``linear_counts``): the identity without one. Saturation
    is judged on raw counts. The attribute ``linearity_applied`` names the applied curve.

    Where the calibration or the line declares ``masked`` elements, which receive no light, the mean of their
    counts above their dark in a line, the pedestal, is added to the dark of every element of that line;
    elements further than 5 standard deviations from the mean are left out. The attribute ``pedestal_applied``
    records it. The noise of that mean, which all samples of a line share, is in the systematic uncertainty.

    Where the calibration or the line holds ``stray_light``, the share of each band's light that other bands
    receive, or ``band_shift_time``, in which a frame is shifted by a band under the light, the light of other
    bands is subtracted: :math:`c = (1 + D)^{-1} (s - \kappa \sum s)`, where of :math:`n` bands
    :math:`\kappa = \epsilon / (1 + n \epsilon)`, and :math:`\epsilon` is the shift time over the exposure.
    The attribute ``stray_light_applied`` records it; its uncertainty ``stray_light_u`` is in the systematic
    uncertainty.

    The paper's eq. 4 has the exposure ratio inverted and an area in place of the pupil's; altitude never
    enters. Several darks are interpolated in time, or to the line's exposure by bias and
    rate, never by scaling the bias.

    Examples
    --------
    The worked example: 1966.09 counts above the dark in 5 ms.

    >>> import hyperpaint as hp
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> line = worked_example()
    >>> print(f"{float(hp.radiance(line).radiance[0, 0, 0]):.6f}")
    0.165521
    """
    dataset = rename_to_roles(dataset)
    if "counts" not in dataset.variables:
        _require_one_of(dataset, ("counts", "radiance"), "radiance")
        return dataset.assign(require(dataset, ["radiance"], "radiance"))
    cube, values = cube_inputs(dataset, "radiance")
    refuse_calibration(dataset, needs_scale=True)
    (radiances,), quality, _ = slabs.calibrated(
        slabs.line_chunked(cube), lazy_plan(dataset, None, make_plan, cube=values, light=None)
    )
    return _with_product(dataset, "radiance", radiances, quality, applied(values))


@takes_quantities(tilt="degree")
def reflectance(
    dataset: xr.Dataset,
    irradiance: xr.Dataset | None = None,
    *,
    uncertainty: bool = False,
    tilt: Tilt | tuple[float, float] | None = None,
    panel: Panel | Sequence[Panel] | None = None,
    white: Any = None,
    tile: Any = None,
    dark: Any = None,
    keep_bits: int | None = None,
) -> xr.Dataset:
    r"""Reflectance factor under the irradiance measured at the time of every line, or relative to a white.

    Lazy: one task a slab of lines, one pass over memory, no pixel is read.

    Parameters
    ----------
    dataset
        A flight line. From ``counts`` when present, with the variables that `radiance` needs; else from
        ``radiance``; else the stored ``reflectance`` is returned. Further ``time`` (along_track),
        ``wavelength`` and ``fwhm`` (band), ``wavelength_shift`` where there is smile, and the irradiance.
    irradiance
        Replaces the line's own record: ``irradiance`` (irradiance_time, irradiance_wavelength),
        ``irradiance_fwhm`` and optionally ``irradiance_max_gap`` and ``irradiance_clock_uncertainty``, each
        with ``units``.
    uncertainty
        Add standard uncertainties. They need counts, and ``electrons_per_count`` and ``read_noise`` of the
        calibration or from `hyperpaint.radiometry.estimate_noise`.
    tilt
        Attitude of a tilted surface, as `Tilt` or (angle, azimuth) [degree]; needs latitude and longitude.
        Without a ``diffuse_fraction`` of its own, the fraction of the lines is used, else the fraction that
        `hyperpaint.light.diffuse_from_record` derives from the record.
    panel
        A target of known reflectance in the scene, to which every band is scaled; or several, seen at
        different times, which correct the level of the record between them. Their measured factors and states
        are stored beside reflectance, see `panel_closure`. By default the scale that `hyperpaint.process`
        derived from the panels which the line declares (attribute ``panels``), in crops as well;
        ``dataset.drop_vars("panel_weight")`` leaves it out.
    white, tile, dark
        Cube of a white tile in the light of the scene, the tile's reflectance factor (0.95, or the file of
        its certificate), and the dark of the scene, see `white_reference`: then the line needs neither
        calibration nor irradiance, nor position and time. A line that `white_reference` calibrated needs none
        of the three.
    keep_bits
        Mantissa bits that are kept, rounding to nearest-even; all 23 by default.

    Returns
    -------
    Dataset
        The line with ``reflectance`` (along_track, band, cross_track), float32 [1], ``quality`` (along_track,
        cross_track), uint16, ``irradiance_age`` (along_track), float32 [s], ``timing_sensitivity``
        (along_track), float32 [1]: the relative change of irradiance within the clocks' uncertainty, and
        ``irradiance_misfit`` (band), float32 [1]. NaN where a sample is saturated, an element bad, or a line
        outside the irradiance record or in a gap of it. Values below 0 and, in glint, above 1 are kept. With
        ``uncertainty`` also ``reflectance_u_random`` and ``reflectance_u_systematic``, as ``reflectance``,
        with obsarray's attributes, which name the known components.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        Variables are missing, or have other dims or units, or irradiance times do not increase; every
        problem is listed. The gain has no absolute scale and there is no ``panel``. When computed: values are
        out of range; or all panels are refused, with the reason.

    Warns
    -----
    PaintWarning
        The line has a scale by panels that was derived with another record than ``irradiance``.

    Notes
    -----
    .. math:: \rho = \pi L / E

    with :math:`E` the downwelling irradiance on a level surface in the imager's band at that column, linear
    in time between the two samples around the line. It is a hemispherical-conical reflectance factor, the
    irradiance-weighted mean over the band's response; no cosine of the sun's zenith angle enters, since the
    receptor already measures horizontal irradiance. The paper's eq. 6 prints a product of radiance and
    irradiance, which is not a reflectance.

    Uncertainties are absolute, so that they hold at and below zero:

    .. math:: u_r &= \frac{\pi g}{t E} \sqrt{\max(C - D, 0) / k + \sigma_r^2 + 1/12} \\
              u_s^2 &= \rho^2 (u_g^2 + u_E^2)
              + \left(\frac{\pi}{E} \frac{\partial L}{\partial \lambda} u_\lambda\right)^2
              + \left(\frac{\pi g}{t E}\right)^2 (u_D^2 + u_{D,s}^2)

    with :math:`k` electrons a count, :math:`\sigma_r` the read noise, 1/12 for whole counts, :math:`u_D` of
    the mean dark, and the ``radiance_gain_u_*``, ``irradiance_u_systematic``, ``wavelength_u`` and
    ``dark_counts_u_systematic`` of the dataset; missing ones count as zero. Wavelength acts on radiance,
    since the irradiance is matched to the assumed wavelengths: where the light is flat, it is
    :math:`\partial\rho / \partial\lambda`, beside an absorption band of the air mostly the slope of the
    light. With a panel, its own uncertainty replaces the components that all elements share. In a mean each
    component shrinks as far as samples do not share it; see `hyperpaint.radiometry.mean_uncertainty`. Where
    counts are made linear, :math:`u_r` grows by the slope :math:`\ell'` of that curve, and ``linearity_u`` is
    added to the gain's uncertainty.

    References
    ----------
    .. [1] Z. Mulhollan, A. Rangnekar, T. Bauch, M. J. Hoffman, A. Vodacek, "Calibrated Vehicle Paint
       Signatures for Simulating Hyperspectral Imagery", CVPR Workshops 2020, section 3.

    Examples
    --------
    >>> import hyperpaint as hp
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> line = worked_example()
    >>> print(f"{float(hp.reflectance(line).reflectance[0, 0, 0]):.6f}")
    0.400000
    """
    return _reflectance(
        _relative_to_white(dataset, white, tile, dark, irradiance),
        irradiance,
        uncertainty=uncertainty,
        tilt=tilt,
        panels=several_panels(panel),
        keep_bits=keep_bits,
    )


def _relative_to_white(
    dataset: xr.Dataset, white: Any, tile: Any, dark: Any, irradiance: xr.Dataset | None
) -> xr.Dataset:
    # Return a line with a white reference, if one is passed, and without its own where a record is passed.
    SchemaError.raise_if(
        white is None and not (tile is None and dark is None),
        "tile= and dark= without white=",
        mend="pass the cube of the white tile; a target in the scene is panel=hp.Panel(...)",
        code="argument-missing",
    )
    SchemaError.raise_if(
        white is not None and irradiance is not None,
        "both white= and irradiance=",
        mend="pass one of them",
        code="option-conflict",
    )
    if white is not None:
        return white_reference(dataset, white, tile=tile, dark=dark)
    return dataset if irradiance is None else dataset.drop_vars(WHITE_VARIABLES, errors="ignore")


@takes_quantities()
def panel_closure(
    dataset: xr.Dataset, panel: Panel | Sequence[Panel], irradiance: xr.Dataset | None = None
) -> xr.Dataset:
    r"""Return the ratio of measured to expected panel reflectance, and the state of each panel.

    Lazy. The same is stored beside ``reflectance(panel=)``, which refuses doubtful panels; this function
    refuses none.

    Parameters
    ----------
    dataset, irradiance
        As of `reflectance`.
    panel
        One panel, or several.

    Returns
    -------
    Dataset
        ``panel_factor``, ``panel_factor_u`` and ``panel_used`` (panel, band), float32 [1]: the factor, its
        combined standard uncertainty, and the share of pixels used; ``panel_state`` (panel), uint8, bits of
        the faults found; ``panel_time`` (panel).

    Raises
    ------
    SchemaError, UnitsError, TimeError
        As `reflectance`; a panel's region lies outside of the line, or contains no valid pixel.

    Notes
    -----
    .. math:: F = \frac{1}{\rho} \left\langle \frac{\pi L}{E} \right\rangle

    Computing warns of saturated pixels, pixels that are shaded or show something else, a mean with more than
    1 % standard error, the spectrum of a tilted panel, and a factor beyond twice its uncertainty. Methods and
    thresholds: `hyperpaint.radiometry.panel_judging`.

    Examples
    --------
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> line = worked_example()
    >>> whole = Panel(slice(None), slice(None), 0.4)
    >>> panel_closure(line, whole).panel_factor.values.round(3)
    array([[1., 1., 1.]], dtype=float32)
    """
    return _reflectance(dataset, irradiance, panels=several_panels(panel), refuses=False)[list(CLOSURE)]


def _reflectance(
    dataset: xr.Dataset,
    irradiance: xr.Dataset | None,
    *,
    uncertainty: bool = False,
    tilt: Tilt | tuple[float, float] | None = None,
    panels: tuple[Panel, ...] = (),
    keep_bits: int | None = None,
    refuses: bool = True,
) -> xr.Dataset:
    # Compute `reflectance`; with `refuses=False` panels are judged but not refused.
    dataset = rename_to_roles(dataset)
    if isinstance(tilt, tuple) and len(tilt) == 2:
        tilt = Tilt(*tilt)
    if tilt is not None and not isinstance(tilt, Tilt):
        raise SchemaError(
            f"tilt={tilt!r}", expected="hyperpaint.Tilt or (angle, azimuth) in degrees", code="type-wrong"
        )
    _require_one_of(dataset, ("counts", "radiance", "reflectance"), "reflectance")
    if not {"counts", "radiance"} & set(dataset.variables):
        SchemaError.raise_if(
            any(option is not None for option in (irradiance, tilt, panels or None, keep_bits)),
            "irradiance=, tilt=, panel= and keep_bits= need more than 'reflectance'",
            expected="'counts' or 'radiance'",
            code="option-conflict",
        )
        return dataset.assign(
            require(dataset, ["reflectance", *(UNCERTAINTIES if uncertainty else ())], "reflectance")
        )
    is_white = has_white(dataset)
    SchemaError.raise_if(
        is_white and (tilt is not None or bool(panels)),
        "tilt= or panel= for a line with a white reference",
        expected="neither: scene and tile lie in the same light",
        mend='drop the variable "reflectance_gain" to use the irradiance record',
        code="option-conflict",
    )
    stored = None if panels or is_white else declared_scale(dataset, other_light=irradiance is not None)
    if irradiance is not None:
        dataset = replace_record(dataset, irradiance)
    scale_panels = panels if stored is None else declared_panels(dataset)
    SchemaError.raise_if(
        keep_bits is not None and not 1 <= keep_bits <= 23,
        f"keep_bits={keep_bits}",
        expected="1 to 23 mantissa bits of float32",
        code="value-out-of-range",
    )
    cube, inputs = plan_inputs(
        dataset, stored, scale_panels, tilt=tilt, keep_bits=keep_bits, uncertainty=uncertainty
    )
    if panels:
        inputs["panel"] = panel_inputs(dataset, panels, reflectance) | {"refuses": refuses}
    # plans of level surfaces, without panels, are cached
    options = (stored is None, keep_bits, uncertainty) if tilt is None and not panels else None
    uncertain = inputs["uncertain"]
    cubes, quality, plan = slabs.calibrated(
        slabs.line_chunked(cube),
        lazy_plan(dataset, options, make_plan, **inputs),
        cubes=1 if uncertain is None else 3,
    )
    attributes = {"tilt": str(tilt) if tilt else None, "panel": "; ".join(map(str, scale_panels)) or None}
    attributes |= applied(inputs["cube"])
    if is_white:
        attributes["white"] = "; tile ".join(str(dataset.attrs[k]) for k in WHITE_ATTRS if k in dataset.attrs)
    # drop uncertainties of an earlier reflectance
    result = _with_product(
        dataset.drop_vars(UNCERTAINTIES, errors="ignore"), "reflectance", cubes[0], quality, attributes
    )
    if uncertain is not None:
        result = with_uncertainty(result, cubes[1:], uncertain)
    if is_white:
        return result
    lines, bands = cube.sizes[ALONG_TRACK], cube.sizes[BAND]
    light_of_lines = dask.delayed(slabs.light_of_lines, pure=True)
    for name, (values, dim, size) in {
        "irradiance_age": (light_of_lines(plan, "age"), ALONG_TRACK, lines),
        "timing_sensitivity": (light_of_lines(plan, "sensitivity"), ALONG_TRACK, lines),
        "irradiance_misfit": (plan.misfit, BAND, bands),
    }.items():
        result[name] = label(xr.DataArray(da.from_delayed(values, (size,), np.float32), dims=dim), name)
    if stored is not None:
        return result
    # replace the panels of an earlier reflectance
    result = without_panels(result)
    return result.assign(closure_variables(plan, len(panels), bands, lines)) if panels else result


def _require_one_of(dataset: xr.Dataset, names: tuple[str, ...], purpose: str) -> None:
    if not set(names) & set(dataset.variables):
        variables = ", ".join(map(str, dataset.data_vars)) or "no variable"
        raise SchemaError(
            f"cannot compute {purpose} from {variables}",
            expected=f"'counts' with {', '.join(COUNTED[1:])}, or {' or '.join(map(repr, names[1:]))}",
            mend="pass white=, tile= and dark= for raw counts" if purpose == "reflectance" else "",
            code="variable-missing",
        )


def applied(values: dict[str, Any]) -> dict[str, str | None]:
    # Return the attributes that name the applied detector corrections; None for corrections not applied.
    linearity: Linearity | None = values.get("linearity")
    attributes: dict[str, str | None] = {}
    if linearity is not None:
        attributes["linearity_applied"] = linearity.described(TABLE[0] in values)
    if "masked" in values:
        attributes["pedestal_applied"] = "mean of the masked elements of each line, beyond their dark"
    attributes["stray_light_applied"] = described(values)
    return attributes


def _with_product(
    dataset: xr.Dataset, name: str, cube: Any, quality: Any, attributes: dict[str, str | None]
) -> xr.Dataset:
    # Return the dataset with a calibrated cube, its quality, and `attributes` that are not empty.
    earlier_quality = None
    if "quality" in dataset.variables:
        earlier_quality = require(dataset, ["quality"], name)["quality"].variable
    bits = merged_quality(name, quality, earlier_quality, anew="counts" in dataset.variables)
    attrs = {key: text for key, text in attributes.items() if text}
    values = label(xr.DataArray(cube, dims=CUBE), name, **attrs)
    return dataset.assign({name: values, "quality": bits})


def merged_quality(name: str, quality: Any, before: xr.Variable | None, *, anew: bool) -> xr.DataArray:
    # Return the flags of a product, merged with flags that were set before.
    #
    # ``anew``: flags derived from counts replace earlier ones.
    flags = xr.DataArray(quality, dims=(ALONG_TRACK, CROSS_TRACK))
    attrs: dict[str, Any] = {}
    if before is not None:
        # bits of other rooms, such as glint or shadow, stay
        flags = flags | (before & np.uint16(0xFFFF ^ (int(_PRODUCT_BITS[name]) if anew else 0)))
        attrs = {key: text for key, text in before.attrs.items() if key == "flags_from"}
    return label(flags.astype(np.uint16), "quality", **attrs)


# -- Calibrate whole lines in memory at once, in the calling thread: the unit of work for any engine.


@takes_quantities(tilt="degree")
def slab(
    dataset: xr.Dataset,
    *,
    uncertainty: bool = False,
    tilt: Tilt | tuple[float, float] | None = None,
    keep_bits: int | None = None,
) -> xr.Dataset:
    """Reflectance and quality of some whole lines: numpy in, numpy out, the bits of ``.paint.reflectance()``.

    For engines other than dask, and for user loops: the function, its inputs and its outputs can be
    pickled, and no scheduler is used. Recipes for cubed, Ray, process pools and dask.distributed are in
    docs/howto/engines.md.

    Parameters
    ----------
    dataset
        Whole lines of a flight line, with their calibration: ``line.isel(along_track=slice(0, 32))``.
        Variables that are read from files on demand (``chunks=None``) are read here; 32 to 256 lines are a
        good size.
    uncertainty, tilt, keep_bits
        As of `hyperpaint.reflectance`.

    Returns
    -------
    Dataset
        The lines in memory, with the variables that `hyperpaint.reflectance` adds.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        As `hyperpaint.reflectance`, at once; or variables are arrays of dask.

    Notes
    -----
    Lines do not depend on one another, so the bits are those of the whole line. Three options use all lines
    passed: ``tilt`` their mean position, ``uncertainty`` the largest share of the dark's noise,
    and darks of several exposures the range of the lines' exposures, where these differ.

    Examples
    --------
    >>> import hyperpaint as hp
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> line = worked_example()
    >>> print(f"{hp.slab(line).reflectance.values[0, 0, 0]:.6f}")
    0.400000
    """
    line = rename_to_roles(dataset)
    lazy = [str(name) for name, variable in line.variables.items() if variable.chunks is not None]
    SchemaError.raise_if(
        lazy,
        f"slab computes no dask arrays: {', '.join(lazy[:3])}{', ...' if len(lazy) > 3 else ''}",
        expected="lines in memory",
        mend="pass line.load(), open with chunks=None, or call .paint.reflectance() on all lines",
        code="lines-not-loaded",
    )
    line = line.compute()  # reads variables that are opened with chunks=None
    cubes = {name: line[name] for name in ("counts", "radiance") if name in line.data_vars}
    # one chunk with a random name: a hash of the values would take a pass over them
    single_chunk = {
        name: cube.copy(data=da.from_array(cube.values, chunks=-1, name=False))
        for name, cube in cubes.items()
    }
    product = reflectance(line.assign(single_chunk), uncertainty=uncertainty, tilt=tilt, keep_bits=keep_bits)
    return product.compute(scheduler="synchronous").assign(cubes)
