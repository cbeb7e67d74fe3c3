"""Detection of paints in a flight line: labels, units and the lazy graph."""

from __future__ import annotations

from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask._task_spec import DataNode, Task, TaskRef, convert_legacy_graph
from dask.highlevelgraph import HighLevelGraph

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.many_outputs import split_outputs
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    LIBRARY_VARIABLES,
    SIGNATURE,
    Quality,
)
from hyperpaint.base.units import takes_quantities
from hyperpaint.paints.paint_search import MIN_BANDS, interpolated
from hyperpaint.paints.signatures import EXCLUDED
from hyperpaint.paints.starter_paints import starter_library
from hyperpaint.radiometry import to_nominal
from hyperpaint.surroundings.corrections import sky_above
from hyperpaint.surroundings.light_split import says_its_split, split_of

from .detectors import METHODS, distances, scores
from .false_alarms import (
    DETECTION,
    BackgroundPart,
    Detector,
    DetectorSettings,
    background_part,
    joined_parts,
    make_detector,
)

MAX_OTHER_SPECTRA = 20_000
JOINED_PARTS = 16
_LAYERS = ("detection_score", "best_paint", "paint_distance", "paint_level", "detected")
_DETECTOR_FIELDS = {
    "score_threshold": "threshold",
    "distance_limit": "distance_limit",
    "checked_rate": "checked_rate",
    "checked_rate_u": "checked_rate_u",
    "explained_share": "explained_share",
}


@takes_quantities()
def detect(
    line: xr.Dataset,
    library: xr.Dataset,
    *,
    method: str = "ace",
    false_alarm_rate: float = 1e-3,
    unknown_rate: float | None = None,
    others: xr.Dataset | None = None,
    background: Any = None,
    exclude: Quality | int | None = None,
    sky: Any = "auto",
    shrinkage: float = 0.0,
) -> xr.Dataset:
    r"""Look for the paints of a library in a flight line, at a stated rate of false alarms.

    Lazy except for the wavelengths: computing reads the line twice, for the background and for the search,
    some lines at a time. Results have the same bits for any chunks.

    Parameters
    ----------
    line
        ``reflectance`` (along_track, band, cross_track) [1] and ``wavelength``; ``quality`` where present.
    library
        Paints to look for: ``reflectance`` (signature, band) [1] of the body under its clear coat
        (``specular_component`` excluded), interpolated to the bands of the line.
    method
        "ace", the adaptive coherence (cosine) estimator; "matched_filter"; or "spectral_angle".
    false_alarm_rate
        Share of the background in which any paint may score above its threshold. By default pixels that a
        paint explains are left out of the background, whether they show it or not: the rate does not hold for
        them, and ``explained_share`` is their number.
    unknown_rate
        Share of ``others`` that may be taken for a paint of the library; by default ``false_alarm_rate``; 1
        rejects nothing.
    others
        A library of paints that may occur and are not looked for; by default the starter library. Paints
        named in ``library`` are left out. The rate holds for paints like these: pass the paints of your cars.
        With fewer than ``1 / unknown_rate`` spectra the limits are stricter than necessary.
    background
        Pixels that certainly show none of the paints, (along_track, cross_track) bool: covariance and
        thresholds come from these alone. By default thresholds come from all pixels that no paint explains.
        The rate holds for pixels like these: include objects that look like the paints.
    exclude
        Flags of pixels that are left out of the background, and not detected; by default the flags that
        signatures exclude.
    sky
        Spectrum (band,) of the sky that a clear coat mirrors in any amount, projected out of pixels and
        paints; "auto" for the diffuse light from above, where the line declares it; None for no sky.
    shrinkage
        Weight of the diagonal in the covariance, 0 to 1, for lines with few pixels.

    Returns
    -------
    Dataset
        (along_track, cross_track): ``best_paint``, number of the paint, which the attribute
        ``flag_meanings`` names, -1 where a value is missing; its ``detection_score``, ``paint_distance``
        and ``paint_level``; ``detected``. (signature): ``score_threshold``, ``distance_limit``, 0 where a
        paint cannot be distinguished from others at this rate. ``checked_rate`` with ``checked_rate_u``: mean
        share of alarms in an eighth of the line's background under thresholds from the rest, and half of its
        95 % interval. ``explained_share``: share of the valid pixels that was left out of the background
        since a paint explains them, whether they show it or not; 0 with ``background=``.

    Raises
    ------
    SchemaError
        Variables, options or bands cannot be used; all are listed. When computed: the background has fewer
        valid pixels than bands, or too few for the rate.

    Warns
    -----
    PaintWarning
        When computed: ``explained_share`` is more than ten times the rate.

    Notes
    -----
    With mean and covariance of the background :math:`\mu, C`, a pixel :math:`x` and a paint :math:`t` less
    :math:`\mu`, products :math:`\langle a, b \rangle = a^T C^{-1} b` and the sky's direction projected out,

    .. math:: s_{ACE} = \pm \frac{\langle t, x \rangle^2}{\langle t, t \rangle \langle x, x \rangle}, \qquad
              s_{MF} = \frac{\langle t, x \rangle}{\langle t, t \rangle}

    [1]_ [2]_ with the sign of the product. The score of the spectral angle is its cosine, without
    :math:`\mu` and :math:`C`. C is computed from all valid pixels, with ``background=`` from those pixels
    alone; its diagonal has the weight ``shrinkage``.

    *Threshold*: the score of the same rank in the background for each paint, chosen such that the share of
    pixels above the threshold of any paint is the rate; from pixels spread over all lines (128 MiB of
    samples). Target pixels that no paint explains stay in the background and raise the threshold: there are
    fewer false alarms than stated, and fewer detections; ``background=`` avoids this.

    *Unknown paints*: :math:`x = a t + m s + r` by least squares with the sky s; a pixel is rejected where
    :math:`|r| / |a t|` is above the paint's ``distance_limit``, or a outside of 0.25 to 2.5. A share
    ``unknown_rate`` of ``others`` lies within the limit of any paint. White, silver and grey paints mostly
    cannot be distinguished at 1e-3: they are not detected, which is no error. A metallic paint at another
    angle has another spectrum: look for its signature of a similar geometry.

    References
    ----------
    .. [1] S. Kraut, L. L. Scharf, L. T. McWhorter, "Adaptive subspace detectors", IEEE Trans. Signal Process.
       49, 1-16 (2001).
    .. [2] L. L. Scharf, L. T. McWhorter, "Adaptive matched subspace detectors and adaptive coherence
       estimators", Proc. 30th Asilomar Conf. Signals, Syst., Comput. (1996).

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.paints import search_library, starter_library
    >>> nm = np.linspace(405.0, 995.0, 30)
    >>> red = search_library(starter_library(members=0, wavelength=nm), name="Synthetic Signal Red")
    >>> level = np.random.default_rng(1).normal(0.1, 0.01, (64, 30, 64))
    >>> level[20:24, :, 30:36] = red.reflectance.values[0][:, None]
    >>> line = xr.Dataset({"reflectance": (("along_track", "band", "cross_track"), np.float32(level),
    ...                    {"units": "1"})}, {"wavelength": ("band", nm, {"units": "nm"})})
    >>> detections = detect(line, red, false_alarm_rate=1e-2).compute()
    >>> int(detections.detected.sum()), bool(detections.detected[20:24, 30:36].all())
    (24, True)
    """
    line = schema.rename_to_roles(line)
    variables = schema.require(line, ["reflectance", "wavelength"], "a detection")
    rate = false_alarm_rate if unknown_rate is None else unknown_rate
    cube = variables["reflectance"]
    problems = Problems("paints cannot be looked for in this line", SchemaError)
    if set(cube.dims) != set(CUBE) or not cube.size:
        problems.add(
            f"reflectance has dims {dict(cube.sizes)}", expected="lines, bands and columns", code="dims-wrong"
        )
    if method not in METHODS:
        problems.add(f"method={method!r}", expected=f"one of {', '.join(METHODS)}", code="choice-unknown")
    for found, is_valid, expected in (
        (f"false_alarm_rate={false_alarm_rate!r}", 0.0 < false_alarm_rate < 1.0, "a share between 0 and 1"),
        (f"unknown_rate={rate!r}", 0.0 < rate <= 1.0, "a share above 0, at most 1"),
        (f"shrinkage={shrinkage!r}", 0.0 <= shrinkage <= 1.0, "0 to 1"),
    ):
        if not is_valid:
            problems.add(found, expected=expected, code="value-out-of-range")
    if "good" in line.variables and line["good"].dims != (BAND,):
        problems.add(f"'good' has dims {line['good'].dims}", expected=f"({BAND!r},)", code="dims-wrong")
    problems.raise_if_any()
    if "wavelength_shift" in line.variables:
        variables["reflectance"] = to_nominal(line)["reflectance"]
    paints, bands, unknown = _spectra(line, variables["wavelength"].values, library, others)
    # blocks of 32 whole lines
    cube = variables["reflectance"].transpose(*CUBE)
    cube = cube.chunk({ALONG_TRACK: CHUNK_LINES, BAND: -1, CROSS_TRACK: -1}).data
    if "quality" in line.variables:
        bits = schema.require(line, ["quality"], "a detection")["quality"].transpose(ALONG_TRACK, CROSS_TRACK)
        flags = np.uint16(int(EXCLUDED if exclude is None else exclude))
        clear = (da.asarray(bits.data).rechunk((CHUNK_LINES, -1)) & flags) == 0
    else:
        clear = da.ones((cube.shape[0], cube.shape[2]), chunks=(cube.chunks[0], -1), dtype=bool)
    detector = _lazy_detector(
        line,
        cube,
        clear if background is None else clear & _mask(background, clear),
        bands,
        paints,
        unknown,
        DetectorSettings(method, false_alarm_rate, rate, shrinkage, background is None),
        sky,
    )
    names = [str(name) for name in library[SIGNATURE].values]
    attrs = {"method": method, "false_alarm_rate": false_alarm_rate, "unknown_rate": rate}
    return _search(line, cube, clear, detector, names, attrs)


def _spectra(
    line: xr.Dataset, wavelength: Array, library: xr.Dataset, others: xr.Dataset | None
) -> tuple[Floats, Ints, Floats]:
    # Paints (signature, band), the bands compared, and spectra of other paints (other, band)
    nm = np.asarray(wavelength, np.float64)
    paints = _on_bands(library, nm, members=False)
    good = np.isfinite(nm)
    if "good" in line.variables:
        good &= line["good"].values.astype(bool)
    bands = np.flatnonzero(good & np.isfinite(paints).all(axis=0) if len(paints) else good & False)
    if bands.size < MIN_BANDS:
        raise SchemaError(
            f"the {len(paints)} paints of the library have values in {bands.size} of the line's "
            f"{int(good.sum())} good bands",
            expected=f"at least 1 paint and {MIN_BANDS} common bands",
            mend="use a library that covers the wavelengths of the line and has no gaps",
            code="bands-not-shared",
        )
    if others is None:
        others = starter_library(wavelength=np.unique(nm[bands]))
    names = {str(name) for name in library[SIGNATURE].values}
    others = others.isel({SIGNATURE: [str(name) not in names for name in others[SIGNATURE].values]})
    unknown = _on_bands(others, nm[bands], members=True)
    unknown = unknown[np.isfinite(unknown).all(axis=1)]
    if not len(unknown):
        raise SchemaError(
            f"no paint of others= has values in all {bands.size} bands that line and library share",
            mend="pass others= a library that covers these bands, with paints that library= lacks",
            code="other-paints-missing",
        )
    return paints[:, bands], bands, unknown[:: -(-len(unknown) // MAX_OTHER_SPECTRA)]


def _on_bands(library: xr.Dataset, nm: Floats, *, members: bool) -> Floats:
    # Spectra of a library (spectrum, band), and its members if wanted, at wavelengths [nm]
    names = [
        "reflectance",
        "wavelength",
        *(["member_reflectance"] if "member_reflectance" in library else []),
    ]
    variables = schema.require(library, names if members else names[:2], "a detection", LIBRARY_VARIABLES)
    wavelength = np.asarray(variables["wavelength"].values, np.float64)
    spectra = [np.asarray(variables["reflectance"].values, np.float64)]
    if members and "member_reflectance" in variables:
        rows = np.asarray(variables["member_reflectance"].values, np.float64).reshape(-1, wavelength.size)
        spectra.append(rows[np.isfinite(rows).any(axis=1)])
    return np.array([interpolated(nm, wavelength, spectrum) for spectrum in np.concatenate(spectra)]).reshape(
        -1, nm.size
    )


def _mask(background: Any, clear: Any) -> Any:
    if hasattr(background, "dims"):
        mask = schema.rename_to_roles(background.to_dataset(name="background"))["background"]
        if set(mask.dims) != {ALONG_TRACK, CROSS_TRACK}:
            raise SchemaError(
                f"background= has dims {background.dims}", expected="lines and columns", code="dims-wrong"
            )
        background = mask.transpose(ALONG_TRACK, CROSS_TRACK).data
    mask = da.asarray(background)
    if mask.shape != clear.shape or mask.dtype != bool:
        raise SchemaError(
            f"background= is {mask.dtype} of shape {mask.shape}",
            expected=f"bool of shape {clear.shape}",
            code="grid-mismatch",
        )
    return mask.rechunk(clear.chunks)


def _lazy_detector(
    line: xr.Dataset,
    cube: Any,
    clear: Any,
    bands: Ints,
    paints: Floats,
    unknown: Floats,
    settings: DetectorSettings,
    sky: Any,
) -> Any:
    # Delayed detector: sums over blocks in their order, then thresholds
    blocks, masks = cube.to_delayed().ravel(), clear.to_delayed().ravel()
    pixels = max(1, cube.shape[0] * cube.shape[2])
    share = min(1.0, DETECTION.sample_bytes / (4.0 * bands.size * pixels))
    size = int(np.ceil(share * CHUNK_LINES * cube.shape[2]))
    part = dask.delayed(_part_of, pure=True)
    parts = [
        part(*block_and_mask, bands, number, size)
        for number, block_and_mask in enumerate(zip(blocks, masks, strict=True))
    ]
    join = dask.delayed(joined_parts, pure=True)
    while len(parts) > 1:
        parts = [join(parts[at : at + JOINED_PARTS]) for at in range(0, len(parts), JOINED_PARTS)]
    if isinstance(sky, str) and sky == "auto":
        of_light = [name for name in line.variables if not {ALONG_TRACK, CROSS_TRACK} <= set(line[name].dims)]
        sky = dask.delayed(_sky_of)(line[of_light], bands)
    elif sky is not None:
        sky = np.asarray(sky, np.float64)
        if sky.shape != (cube.shape[1],):
            raise SchemaError(
                f"sky= has shape {sky.shape}",
                expected=f"({cube.shape[1]},), one value a band",
                code="length-mismatch",
            )
        sky = sky[bands]
    return dask.delayed(make_detector, pure=True)(parts[0], bands, paints, sky, unknown, settings)


def _after(first: Any, array: Any) -> Any:
    """Return a copy of a dask array under other keys, computed only after a delayed object.

    Blocks shared by two passes would all be held in memory from the first to the second, and read ahead of
    it. `dask.graph_manipulation.bind` does the same, but loses the keys of rechunks.
    """
    graph = convert_legacy_graph(dict(array.dask))
    keys = {key: ("again-" + key[0], *key[1:]) if isinstance(key, tuple) else f"again-{key}" for key in graph}
    copy = {}
    for key, task in graph.items():
        new_key = keys[key]
        if isinstance(task, DataNode):
            copy[new_key] = Task(new_key, _second, TaskRef(first.key), task.value)
        elif isinstance(task, Task) and not task.dependencies:
            copy[new_key] = Task(
                new_key, _call_second, TaskRef(first.key), task.func, *task.args, **task.kwargs
            )
        else:
            copy[new_key] = task.substitute(keys, key=new_key)
    name = f"again-{array.name}"
    graph = HighLevelGraph.from_collections(name, copy, dependencies=[first])
    return da.Array(graph, name, array.chunks, meta=array._meta)


def _second(_: Any, value: Any) -> Any:
    return value


def _call_second(_: Any, function: Any, *args: Any, **options: Any) -> Any:
    return function(*args, **options)


def _part_of(cube: Array, clear: Bools, bands: Ints, number: int, size: int) -> BackgroundPart:
    cube = cube[:, bands]
    return background_part(cube, clear & np.isfinite(cube).all(axis=1), number, size)


def _sky_of(line: xr.Dataset, bands: Ints) -> Floats | None:
    # Sky that a level coat mirrors, up to a factor (band,); None where it is not declared
    if not says_its_split(line):
        return None
    split = split_of(line, None, None).mean()
    sky = np.asarray((split.fraction * sky_above(split)).values, np.float64)[bands]
    return sky if np.isfinite(sky).all() and sky.any() else None


def _search(
    line: xr.Dataset, cube: Any, clear: Any, detector: Any, names: list[str], attrs: dict[str, Any]
) -> xr.Dataset:

    cube = _after(detector, cube)
    blocks = da.blockwise(
        search_block,
        "lbx",
        cube,
        "lbx",
        clear,
        "lx",
        detector=detector,
        dtype=object,
        concatenate=True,
        meta=np.empty((0, 0, 0), object),
        adjust_chunks={"b": 1},
    )
    layout = {number: ("lx", schema.dtype_of(name)) for number, name in enumerate(_LAYERS)}
    pixel = (ALONG_TRACK, CROSS_TRACK)
    arrays = {
        name: schema.label(xr.DataArray(array, dims=pixel), name)
        for name, array in zip(_LAYERS, split_outputs(blocks, "lbx", layout).values(), strict=True)
    }
    for name, field in _DETECTOR_FIELDS.items():
        dims = schema.VARIABLES[name].dims
        data = da.from_delayed(getattr(detector, field), (len(names),) * len(dims), np.float64)
        arrays[name] = schema.label(xr.DataArray(data, dims=dims), name)
    arrays["best_paint"].attrs |= {
        "flag_values": np.arange(-1, len(names), dtype=np.int16),
        "flag_meanings": " ".join(["none", *(name.replace(" ", "_") for name in names)]),
    }
    arrays["detected"].attrs |= attrs
    places = {
        name: array for name, array in line.coords.items() if set(array.dims) <= set(pixel) and array.dims
    }
    identity = {"name": line.attrs["name"]} if line.attrs.get("name") else {}
    return xr.Dataset(arrays, {**places, SIGNATURE: (SIGNATURE, names)}, identity | attrs)


def search_block(cube: Array, clear: Bools, detector: Detector) -> tuple[Array, ...]:
    """Return the layers of a block (line, band, column), each (line, column), in the order of `_LAYERS`."""
    shape = clear.shape
    score, distance, level = (np.full(shape, np.nan, np.float32) for _ in range(3))
    best, detected = np.full(shape, -1, np.int16), np.zeros(shape, bool)
    scale = detector.threshold - detector.usual
    for number, values in enumerate(cube[:, detector.bands]):
        spectra = np.ascontiguousarray(values.T, np.float64)
        whole = np.asarray(np.isfinite(spectra).all(axis=1))
        spectra[~whole] = 0.0
        paint_scores = scores(spectra, detector.project, detector.method)
        paint_distances, levels = distances(spectra, detector.paints, detector.sky)
        passes: Array = (paint_scores >= detector.threshold) & detector.is_near(paint_distances, levels)
        standing = (paint_scores - detector.usual) / scale
        some = np.max(passes, axis=1, keepdims=True)
        chosen = np.where(whole[:, None], np.where(passes >= some, standing, -np.inf), 0.0)
        paint = np.argmax(chosen, axis=1)
        place = np.arange(len(paint))
        for layer, of_paints in ((score, paint_scores), (distance, paint_distances), (level, levels)):
            layer[number] = np.where(whole, of_paints[place, paint], np.nan)
        best[number] = np.where(whole, paint, -1)
        detected[number] = some[:, 0] & whole & clear[number]
    return score, best, distance, level, detected
