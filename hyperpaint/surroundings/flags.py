"""Glint, shadow, coloured light from neighbours and mixed pixels: layers, and bits by thresholds.

Every pixel is unmixed into the reflectance of its body in the scene model, under changed amounts of sun and
sky, plus mirrored sun and sky and the light of coloured neighbours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented, is_number, takes_quantities
from hyperpaint.base.many_outputs import split_outputs
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, Array, Progress, Quality, flags_set_from
from hyperpaint.radiometry.slabs import line_chunked
from hyperpaint.radiometry.spectral_axis import to_nominal

from . import SceneModel, survey
from .detection_rules import FLAGS, MIRROR
from .model import SHADED
from .segments import SATURATED_IN_LOBE, Light, max_excesses
from .surveying import to_channels, to_nominal_channels

#: Layers from which bits are set, and layers that explain them.
LAYERS = ("glint_fraction", "blocked_direct", "adjacency", "adjacency_segment", "mirrored_sky")


@takes_quantities(sun_zenith="degree", sun_azimuth="degree", heading="degree")
@documented(progress="survey progress")
def flag(
    line: xr.Dataset,
    model: SceneModel | xr.Dataset | None = None,
    *,
    glint: float = 0.04,
    shadow: float = 0.2,
    adjacency: float = 0.01,
    edge: int = 1,
    progress: Progress | bool | None = None,
    **options: Any,
) -> xr.Dataset:
    r"""Set the bits of glint, shadow, adjacency and mixed edges, and add their layers.

    Lazy and pointwise given ``model``: one task a slab of lines. Without a model,
    `hyperpaint.surroundings.survey` is run first, which reads the line once.

    Parameters
    ----------
    line
    model
        From `hyperpaint.surroundings.survey` of the same line, or its stored Dataset.
    glint
        Reflectance added by the mirrored sun, relative to the rest, above which a pixel is in glint [1].
    shadow
        ``blocked_direct`` from which a pixel is in shadow [1], in and beside segments of the ground that the
        model holds as cast shadow, and in single pixels of it; on other objects in such segments only, and
        from 0.6 on: elsewhere missing light is tilt.
    adjacency
        ``adjacency`` above which a pixel is lit by a coloured neighbour [1].
    edge
        Distance from a boundary up to which a pixel is mixed [pixel], 0 for pixels in between only.
    progress
    **options
        Options of `hyperpaint.surroundings.survey`, used without ``model``.

    Returns
    -------
    Dataset
        The same with ``quality``, in which bits set before stay set, and (along_track, cross_track), float32
        [1]: ``glint_fraction`` g, in units of reflectance under the sun alone; ``blocked_direct`` 1 - c, the
        part of the direct light that is missing, negative where a surface leans towards the sun;
        ``adjacency``, the largest reflectance in any channel that coloured neighbours add, and
        ``adjacency_segment``, int32, the segment of the model that adds most of it, -1 for none;
        ``mirrored_sky`` s, beyond that of the rest of the body. NaN without data.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, thresholds are negative or not finite, or the model is of another line; all are
        listed.

    Notes
    -----
    With :math:`\rho` the body's reflectance in full light, :math:`\rho_n` those of the two nearest coloured
    neighbours and :math:`f_{dir} + f_{dif} = 1` the parts of the irradiance,

    .. math:: \rho_{obs} = \rho (c f_{dir} + V f_{dif}) + g f_{dir} + (s l_z + a l_\odot) f_{dif}
              + \textstyle\sum_n (b_n \rho \rho_n + c_n \rho_n)

    is solved exactly for amounts that are not negative, by least squares with priors of 1 for c and V and of
    0 for other amounts, after [1]_. Standard deviations are the noise that the survey measured, and 0.7 % of
    variation within bodies. g and the sum over neighbours are 0 unless leaving them out is worse by three
    standard deviations, of the misfit where that is more than noise (a likelihood ratio). A surface that
    mirrors the sun to a camera above faces halfway to it: with glint, c is expected to be
    cos(z/2) / cos(z), and is at least 0.7. Coats mirror the zenith, of radiance :math:`l_z` over the mean of
    the sky, and the sky around the sun, which is brighter by :math:`l_\odot` and redder; with glint, a is
    expected to be 0.04. Both are those of a clear sky where the split is.

    Only the sum over neighbours is well determined; light of a grey neighbour cannot be distinguished from
    tilt, and parts of one car are no neighbours of each other. On grey bodies a mirrored sun has the colour
    of their own light: there g is the brightness beyond the largest effect of tilt, or, on bodies of which
    more than half is brighter than their darkest parts, beyond their other parts. Smile is removed from the
    channels, which are some 25 nm wide, to first order.

    ``glint_fraction`` is all light that looks like direct light of another colour than the body, including
    light from flakes in a paint, and from leaning grey paint. The bit of glint is set only in a lobe of a
    coat, with a core that stands out (`hyperpaint.surroundings.segments`), and in saturated pixels that a
    lobe encloses.

    Known limits: the wide lobe of a worn coat can be distinguished from flakes on coloured and on black paint
    only, and where the body part shows its core; dark glass is taken for asphalt in shadow, so that glint and
    shadow are unreliable on glass. Mixed pixels are detected less well than pixels of one material. For
    measured precision and recall see docs/figures.md.

    References
    ----------
    .. [1] P. Koirala, P. Pant, M. Hauta-Kasari, J. Parkkinen, "Highlight detection and removal from spectral
       image", J. Opt. Soc. Am. A 28, 2284-2291 (2011). doi:10.1364/JOSAA.28.002284

    Examples
    --------
    A grey plane, one pixel of it with 0.1 of the mirrored sun.

    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.light.sun import diffuse_fraction
    >>> nm = np.linspace(400.0, 1000.0, 48)
    >>> seen = np.full((8, 48, 8), 0.3, np.float32)
    >>> seen[4, :, 4] += 0.7 * (1 - diffuse_fraction(nm, 30.0))
    >>> line = xr.Dataset({"reflectance": (("along_track", "band", "cross_track"), seen, {"units": "1"})},
    ...                   {"wavelength": ("band", nm, {"units": "nm"})})
    >>> flagged = flag(line, sun_zenith=30.0)
    >>> int((flagged.quality.values & 64).astype(bool).sum())
    1
    """
    line = schema.rename_to_roles(line)
    cube = schema.require(line, ["reflectance", "wavelength"], "flags")["reflectance"]
    limits = {"glint": glint, "shadow": shadow, "adjacency": adjacency, "edge": edge}
    problems = Problems("thresholds cannot be used", SchemaError)
    for name, value in limits.items():
        problems.add_if(
            not is_number(value) or value < 0,
            f"{name}={value!r}",
            expected="a number from 0 on",
            code="value-out-of-range",
        )
    problems.raise_if_any()
    if model is None:
        model = survey(line, progress=progress, **options)
    elif options:
        raise SchemaError(
            f"{', '.join(options)}= are options of the survey, which does not run with model=",
            mend="pass only one of them",
            code="option-conflict",
        )
    scene = model if isinstance(model, SceneModel) else SceneModel.from_dataset(model)
    problems = Problems("the scene model belongs to another line", SchemaError)
    lines, bands, columns = cube.shape
    problems.add_if(
        scene.segment.shape != (lines, columns),
        f"the model has {scene.segment.shape} pixels",
        expected=f"({lines}, {columns}) as the line",
        code="grid-mismatch",
    )
    # a lazy coordinate is not computed: only its size is compared
    wavelength = scene.wavelength if line["wavelength"].chunks is not None else line["wavelength"].values
    is_same_axis = np.array_equal(scene.wavelength, wavelength, equal_nan=True)
    problems.add_if(
        scene.wavelength.shape != (bands,) or not is_same_axis,
        f"the bands of the model differ from the {bands} bands of the line",
        mend="survey the line that is flagged",
        code="bands-differ",
    )
    problems.raise_if_any()
    # Flags, computed by blocks of lines when asked for
    data = line_chunked(cube).data
    blocks = da.map_blocks(
        _flag_block,
        data,
        dask.delayed(scene, traverse=False, pure=False),
        starts=tuple(int(start) for start in np.cumsum((0, *data.chunks[0][:-1]))),
        limits=limits,
        dtype=object,
        name=None,
        meta=np.empty((0, 0, 0), object),
    )
    pixel = (ALONG_TRACK, CROSS_TRACK)
    layout = {name: ("lx", schema.dtype_of(name)) for name in (*LAYERS, "quality")}
    layers = {
        name: schema.label(xr.DataArray(array, dims=pixel), name)
        for name, array in split_outputs(blocks, "lbx", layout).items()
    }
    # the first three layers have a threshold
    for name, limit in zip(LAYERS, _LIMITS[:3], strict=False):
        layers[name].attrs["threshold"] = limits[limit]
    bits = layers["quality"]
    if "quality" in line.variables:
        line_bits = schema.require(line, ["quality"], "flags")["quality"].variable
        bits = bits.copy(data=(bits.variable | line_bits.transpose(*pixel)).data)
    origin = f"diffuse fraction: {scene.attrs.get('diffuse_fraction_from', 'unknown')}"
    layers["quality"] = schema.label(bits, "quality", flags_from=origin)
    return line.assign(layers)


def _flag_block(
    block: Array,
    model: SceneModel,
    starts: tuple[int, ...],
    limits: dict[str, float],
    block_id: tuple[int, ...] = (0,),
) -> dict[str, Array]:
    from hyperpaint.kernels import arguments
    from hyperpaint.kernels.unmixing import PARTS, unmix_lines

    lines = slice(starts[block_id[0]], starts[block_id[0]] + len(block))
    channels = to_channels(block, model.channel)
    to_nominal_channels(channels, model.channel_wavelength, model.shift)
    shape = channels.shape[:2]
    neighbours = model.neighbours(lines.start, lines.stop)
    amount = np.empty((*shape, PARTS), np.float32)
    added = np.empty((*shape, 2), np.float32)
    together, misfit = np.empty((2, *shape), np.float32)
    # a surface that faces the sun gets the maximum of direct light
    max_amounts, lean = max_excesses(), 0.0
    zenith = float(model.attrs.get("sun_zenith", np.nan))
    if np.isfinite(zenith):
        max_amounts[0] = FLAGS.max_direct / max(np.cos(np.radians(zenith)), 0.2)
        # excess of direct light over level ground on a surface that mirrors the sun to the zenith
        angle = np.radians(min(zenith, 80.0))
        lean = float(np.cos(angle / 2) / np.cos(angle) - 1.0)
    unmix_lines(
        channels,
        arguments.Bodies(model.bodies(lines.start, lines.stop), model.reference, neighbours),
        arguments.LightParts(
            *Light.under(model.diffuse_fraction, model.zenith_radiance, model.sunward_radiance)
        ),
        arguments.ChannelErrors(np.hypot(model.noise, FLAGS.relative_error), FLAGS.floor),
        arguments.AmountPrior(np.array(FLAGS.expected), np.array(FLAGS.spread), model.tilt, max_amounts),
        FLAGS.evidence_sd2,
        arguments.Glinting(lean, MIRROR.coat),
        arguments.Unmixed(amount, added, together, misfit),
    )
    adjacency_segment = np.take_along_axis(neighbours, np.argmax(added, axis=2)[..., None], 2)[..., 0]
    layers = {
        "glint_fraction": amount[..., 2],
        "blocked_direct": 1.0 - amount[..., 0],
        "adjacency": together,
        "adjacency_segment": np.where(together > 0, adjacency_segment, -1),
        "mirrored_sky": amount[..., 3],
    }
    bits = np.zeros(shape, np.uint16)
    added_glint = layers["glint_fraction"] * (1.0 - model.diffuse_fraction).mean()
    without_glint = np.maximum(channels.mean(axis=2) - added_glint, 0.0)
    in_glint = added_glint > np.maximum(limits["glint"] * without_glint, FLAGS.min_glint)
    lobe = model.lobe[lines]
    bits[in_glint & (lobe > 0)] |= np.uint16(Quality.GLINT)
    # missing direct light is that of a cast shadow near one on the ground, and in shaded segments of objects;
    # surfaces that lean away from the sun lack direct light, too: on objects more of it must be missing
    segment, missing = model.segment[lines], layers["blocked_direct"]
    on_ground = np.append(model.ground > 0, False)[segment]
    near = on_ground & (model.shade_distance[lines] <= FLAGS.penumbra_px)
    on_objects = ~on_ground & np.append(model.state == SHADED, False)[segment]
    object_limit = max(limits["shadow"], FLAGS.min_missing_on_objects)
    is_shaded = near & (missing >= limits["shadow"]) | on_objects & (missing >= object_limit)
    bits[is_shaded] |= np.uint16(Quality.SHADOW)
    bits[together > limits["adjacency"]] |= np.uint16(Quality.ADJACENCY)
    bits[model.edge_distance[lines] <= limits["edge"]] |= np.uint16(Quality.MIXED_EDGE)
    bits[segment < 0] = 0
    bits[lobe == SATURATED_IN_LOBE] |= np.uint16(Quality.GLINT)
    return {
        **{name: np.ascontiguousarray(layer, schema.dtype_of(name)) for name, layer in layers.items()},
        "quality": bits,
    }


_SURVEYED_FLAGS = flags_set_from("scene")
#: Arguments of `flag` that are thresholds.
_LIMITS = ("glint", "shadow", "adjacency", "edge")


@dataclass(frozen=True)
class Flagged:
    # A line with its flags.
    line: xr.Dataset  #: The line with ``quality`` and `LAYERS`, lazy.
    surveyed: xr.Dataset  #: The line as surveyed: at nominal wavelengths where it has smile.
    model: SceneModel  #: From `hyperpaint.surroundings.survey`.


def is_flagged(line: xr.Dataset) -> bool:
    # Return whether a line was searched for glint, shadow, adjacency or mixed edges.
    #
    # Reads the values of ``quality`` where its attributes do not record the search.
    if "quality" not in line.variables:
        return False
    quality = line["quality"]
    return "flags_from" in quality.attrs or bool((quality & np.uint16(_SURVEYED_FLAGS)).any())


def without_scene_flags(line: xr.Dataset) -> xr.Dataset:
    # Return a line without bits of glint, shadow, adjacency and mixed edges.
    if "quality" not in line.variables:
        return line
    return line.assign(
        quality=(line["quality"] & np.uint16(~_SURVEYED_FLAGS & 0xFFFF)).assign_attrs(line["quality"].attrs)
    )


def flag_line(
    line: xr.Dataset, *, progress: Callable[[int, int], None] | None = None, **options: Any
) -> Flagged:
    # Survey a line with ``reflectance``, and flag it; a line with smile above 1 nm at nominal wavelengths.
    #
    # ``options`` are thresholds of `flag` and options of `survey`; ``progress`` is called with the numbers of
    # surveyed lines and of all lines; flags are lazy. Raises as `flag` and `survey`.
    has_smile = (
        "wavelength_shift" in line.variables
        and (np.abs(line["wavelength_shift"].values) > FLAGS.max_smile_nm).any()
    )
    surveyed = to_nominal(line) if has_smile else line
    limits = {name: options.pop(name) for name in _LIMITS if name in options}
    model = survey(surveyed, progress=progress, **options)
    flagged = flag(surveyed, model, **limits)
    return Flagged(line.assign({name: flagged[name] for name in ("quality", *LAYERS)}), surveyed, model)
