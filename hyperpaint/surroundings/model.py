"""The scene model: result of the survey of a flight line, small enough to be stored beside it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    FORMAT_VERSION,
    Floats,
    Ints,
    Problems,
    SchemaError,
)

Index = npt.NDArray[np.int32]

#: Side of a cell [pixel].
CELL = 4


def nearest_at(neighbour: Index, body: Index, paint: Index, number: Index, pixels: Ints) -> Index:
    # Return the two coloured bodies nearest to pixels (pixel,), of other paints than the pixel's.
    #
    # (pixel, 2), int32: numbers of segments, -1 for none. Takes ``neighbour`` (cell_along, cell_cross, rank):
    # segments nearest to a cell, -1 for none; ``body``, ``paint`` (segment,): the paint is equal for all
    # bodies of one paint; ``number`` (line, column): segment of every pixel; ``pixels``: their flat indices.
    line, column = np.divmod(pixels, number.shape[1])
    return _first_two(neighbour[line // CELL, column // CELL], body, paint, number[line, column])


def _first_two(candidates: Index, body: Index, paint: Index, number: Index) -> Index:
    # First two bodies of other paints than the pixels' among candidate segments (..., rank)
    bodies, paints = np.append(body, np.int32(-1)), np.append(paint, np.int32(-2))
    first, second = np.full((2, *number.shape), -1, np.int32)
    for candidate in np.moveaxis(bodies[candidates], -1, 0):
        is_new = (candidate >= 0) & (paints[candidate] != paints[number]) & (candidate != first)
        is_second = is_new & (first >= 0) & (second < 0)
        first, second = (
            np.where(is_new & (first < 0), candidate, first),
            np.where(is_second, candidate, second),
        )
    return np.stack([first, second], axis=-1)


#: States of a segment: its surface in full light, in cast shadow, or under the sun's mirror image.
LIT, SHADED, GLINTED = 0, 1, 2

#: Field to its dims, dtype, units and meaning.
_LAYOUT: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    "channel": ((BAND,), "int64", "", "Channel that a band is averaged into; -1 for none"),
    "wavelength": ((BAND,), "float64", "nm", "Centre wavelength at the centre column"),
    "channel_wavelength": (("channel",), "float64", "nm", "Mean wavelength of a channel's bands"),
    "diffuse_fraction": (("channel",), "float64", "1", "Diffuse part of the irradiance on level ground"),
    "zenith_radiance": (("channel",), "float64", "1", "Radiance of the zenith over the mean of the sky"),
    "sunward_radiance": (
        ("channel",), "float64", "1", "Excess of the sky around the sun over the zenith",
    ),
    "shift": (("channel", CROSS_TRACK), "float64", "nm", "True less nominal wavelength of a channel"),
    "noise": (("channel",), "float64", "1", "Standard deviation of a channel, relative to what is seen"),
    "segment": ((ALONG_TRACK, CROSS_TRACK), "int32", "", "Number of the segment; -1 without data"),
    "edge_distance": ((ALONG_TRACK, CROSS_TRACK), "uint8", "1", "Pixels to another surface, 0 in mixed ones"),
    "shade_distance": (
        (ALONG_TRACK, CROSS_TRACK), "uint8", "1", "Pixels to a cast shadow, 0 in it; 255 without a shadow",
    ),
    "lobe": (
        (ALONG_TRACK, CROSS_TRACK), "uint8", "", "Mirror image of the sun: 1 perhaps, 2 saturated, 3 sure",
    ),
    "neighbour": (
        ("cell_along", "cell_cross", "rank"), "int32", "", "Coloured segments nearest to a cell; -1 for none",
    ),
    "size": (("segment_number",), "int64", "1", "Pixels of a segment"),
    "state": (("segment_number",), "int8", "", "0 lit, 1 in a shadow of its body, 2 in glint of its body"),
    "body": (("segment_number",), "int32", "", "Segment that shows the same surface in full light"),
    "ground": (("segment_number",), "int8", "", "1 where the body is ground, 0 where it is a thing on it"),
    "paint": (("segment_number",), "int32", "", "First of the bodies that show the same paint"),
    "tilt": (("segment_number",), "float64", "1", "Spread of the amount of direct light within the body"),
    "spectrum": (("segment_number", "channel"), "float64", "1", "Median reflectance of a segment"),
    "reference": (("segment_number", "channel"), "float64", "1", "Reflectance of the body in full light"),
}  # fmt: skip

#: Values of fields that older models lack: a uniform sky, glint allowed in all pixels, all bodies ground.
_DEFAULTS = {"zenith_radiance": 1.0, "sunward_radiance": 0.0, "lobe": 1, "ground": 1}


@dataclass(frozen=True, eq=False)
class SceneModel:
    """Segments of a flight line, their spectra in full light, and their neighbours.

    `hyperpaint.surroundings.survey` returns it; `to_dataset` returns a form that can be stored. Spectra are
    in *channels*, means over some neighbouring bands.

    Attributes
    ----------
    wavelength : (band,)
        Wavelengths of the surveyed line [nm].
    channel : (band,)
        Channel of every band; -1 for bands that are not used.
    channel_wavelength : (channel,)
        [nm]
    diffuse_fraction : (channel,)
        Diffuse part of the irradiance on level ground [1].
    zenith_radiance, sunward_radiance : (channel,)
        Radiance of the zenith, and its excess 5 degrees from the sun, over the mean of the
        sky [1]; 1 and 0 for a uniform sky, and for models stored without them.
    shift : (channel, cross_track)
        True less nominal wavelength of a channel: smile [nm].
    noise : (channel,)
        Standard deviation of a channel, relative to the reflectance [1].
    segment : (along_track, cross_track)
        Number of every pixel's segment; -1 without data.
    edge_distance : (along_track, cross_track), uint8
        Pixels to the next pixel of another surface; 0 in mixed pixels.
    shade_distance : (along_track, cross_track), uint8
        Pixels to the next cast shadow, 0 in one; 255 far from any.
    lobe : (along_track, cross_track), uint8
        Mirror images of the sun: 1 where only added light shows them, 2 in saturated pixels, 3 where pixels
        are brighter than their body around, else 0; 1 everywhere in models stored without it.
    neighbour : (cell_along, cell_cross, rank)
        Coloured segments nearest to a cell of 4 x 4 pixels, nearest first; -1 for none.
    size, state, body : (segment_number,)
        Number of pixels of a segment; `LIT`, `SHADED` or `GLINTED`; and the segment that shows the same
        surface in full light, for lit segments the segment itself.
    ground : (segment_number,), int8
        1 where the body is level ground, 0 where it is an object that may lean; 1 in models stored without
        it.
    paint : (segment_number,)
        First of the bodies that show the same paint; a body lights no other of its paint.
    tilt : (segment_number,)
        Spread of the amount of direct light within the body [1].
    spectrum, reference : (segment_number, channel)
        Median of a segment's pixels, and of its body without glint and shadow [1].
    attrs
        Settings of the survey, and a digest of the labels of lines and columns.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.surroundings import survey
    >>> nm = np.linspace(400.0, 1000.0, 48)
    >>> seen = np.full((16, 48, 16), 0.1, np.float32)
    >>> seen[:, :, 8:] = 0.5
    >>> cube = ("along_track", "band", "cross_track"), seen, {"units": "1"}
    >>> line = xr.Dataset({"reflectance": cube}, {"wavelength": ("band", nm, {"units": "nm"})})
    >>> model = survey(line, sun_zenith=30.0, diffuse="model")
    >>> model.segment[0, [0, 15]].tolist(), model.size.tolist()
    ([0, 1], [128, 128])
    """

    wavelength: Floats
    channel: Ints
    channel_wavelength: Floats
    diffuse_fraction: Floats
    zenith_radiance: Floats
    sunward_radiance: Floats
    shift: Floats
    noise: Floats
    segment: npt.NDArray[np.int32]
    edge_distance: npt.NDArray[np.uint8]
    shade_distance: npt.NDArray[np.uint8]
    lobe: npt.NDArray[np.uint8]
    neighbour: npt.NDArray[np.int32]
    size: Ints
    state: npt.NDArray[np.int8]
    body: npt.NDArray[np.int32]
    ground: npt.NDArray[np.int8]
    paint: npt.NDArray[np.int32]
    tilt: Floats
    spectrum: Floats
    reference: Floats
    attrs: dict[str, Any] = field(default_factory=dict)

    @property
    def segments(self) -> int:
        """Number of segments."""
        return int(self.size.size)

    def bodies(self, start: int, stop: int) -> npt.NDArray[np.int32]:
        """Return the body of the pixels of some lines, (line, column); -1 without data."""
        return np.append(self.body, np.int32(-1))[self.segment[start:stop]]

    def neighbours(self, start: int, stop: int) -> npt.NDArray[np.int32]:
        """Return `nearest_at` of the pixels of some lines (line, column, 2)."""
        line, column = (np.arange(length) // CELL for length in self.segment.shape)
        return _first_two(
            self.neighbour[line[start:stop]][:, column], self.body, self.paint, self.segment[start:stop]
        )

    def to_dataset(self) -> xr.Dataset:
        """Return the model as a Dataset that `hyperpaint.to_store` takes."""
        variables = {}
        for name, (dims, _, units, meaning) in _LAYOUT.items():
            attrs = {"long_name": meaning, **({"units": units} if units else {})}
            variables["band_channel" if name == "channel" else name] = (dims, getattr(self, name), attrs)
        return xr.Dataset(variables, attrs={"hyperpaint_format": FORMAT_VERSION, **self.attrs})

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> "SceneModel":
        """Return the model stored in a Dataset.

        Raises `SchemaError`: variables are missing or have other dims, types or sizes, numbers refer to
        unknown segments or channels, or values are out of range; all are listed.
        """
        with Problems("the dataset is not a scene model", SchemaError) as problems:
            fields: dict[str, Any] = {}
            for name, (dims, dtype, _, meaning) in _LAYOUT.items():
                stored = "band_channel" if name == "channel" else name
                if stored not in dataset.variables and name in _DEFAULTS:
                    fields[name] = np.full(
                        [dataset.sizes.get(dim, 0) for dim in dims], _DEFAULTS[name], dtype
                    )
                elif stored not in dataset.variables:
                    problems.add(
                        f"{stored!r} is missing: {meaning.lower()} ({', '.join(dims)})",
                        code="variable-missing",
                    )
                elif set(dataset[stored].dims) != set(dims):
                    problems.add(
                        f"{stored!r} has dims {dataset[stored].dims}", expected=f"{dims}", code="dims-wrong"
                    )
                else:
                    values = dataset[stored].transpose(*dims).values
                    # a cast must keep all values in range; both comparisons are False for NaN
                    if values.dtype.kind in "iufb" and (
                        dtype == "float64"
                        or not values.size
                        or (values.min() >= np.iinfo(dtype).min and values.max() <= np.iinfo(dtype).max)
                    ):
                        fields[name] = np.ascontiguousarray(values, dtype)
                    else:
                        problems.add(
                            f"{stored!r} holds {values.dtype} values", expected=f"{dtype}", code="type-wrong"
                        )
            # Check references, counts and ranges of the numbers of the model
            count, channels = dataset.sizes.get("segment_number", 0), dataset.sizes.get("channel", 0)
            for name in ("segment", "neighbour", "body", "paint"):
                numbers = fields.get(name, np.empty(0))
                problems.add_if(
                    not ((numbers >= -1) & (numbers < count)).all(),
                    f"{name!r} refers to segments other than the {count} of the model",
                    code="segment-unknown",
                )
            if "channel" in fields:
                numbers = np.unique(fields["channel"])
                problems.add_if(
                    not channels or not np.array_equal(numbers[numbers != -1], np.arange(channels)),
                    "'band_channel' is incomplete",
                    expected=f"each of the {channels} channels, and -1 for unused bands",
                    code="channel-unknown",
                )
            if {"neighbour", "segment"} <= fields.keys():
                cells = tuple(-(-length // CELL) for length in fields["segment"].shape)
                problems.add_if(
                    fields["neighbour"].shape[:2] != cells,
                    f"'neighbour' has {fields['neighbour'].shape[:2]} cells",
                    expected=f"{cells}",
                    code="grid-mismatch",
                )
            problems.add_if(
                not np.isfinite(fields.get("shift", np.empty(0))).all(),
                "'shift' is not finite",
                code="not-finite",
            )
            for name, low, high in (
                ("noise", 0.0, np.inf),
                ("tilt", 1e-6, np.inf),
                ("diffuse_fraction", 0.0, 1.0),
                ("zenith_radiance", 0.0, np.inf),
                ("sunward_radiance", 0.0, np.inf),
            ):
                values = fields.get(name, np.empty(0))
                problems.add_if(
                    not (np.isfinite(values) & (values >= low) & (values <= high)).all(),
                    f"{name!r} is not finite, or outside {low:g} to {high:g}",
                    code="value-out-of-range",
                )
        return cls(
            **fields,
            attrs={name: value for name, value in dataset.attrs.items() if name != "hyperpaint_format"},
        )

    def __repr__(self) -> str:
        lines, columns = self.segment.shape
        shaded, glinted = ((self.state == state).sum() for state in (SHADED, GLINTED))
        return (
            f"SceneModel({lines} lines x {columns} columns, {self.segments} segments, of which {shaded} in "
            f"shadow and {glinted} in glint, {self.channel_wavelength.size} channels)"
        )
