"""Arguments that the modules of scenes, paints and light refuse, each by its code and words."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.traced_scenes import irradiance_series

from hyperpaint.base.errors import FormatError, PaintError, SchemaError, UnitsError
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.four_curves import Atmosphere, preset_atmosphere
from hyperpaint.simulation.rendering.materials import (
    KINDS,
    Coat,
    Flakes,
    Material,
    base_albedo,
    coat_of_gloss,
    flakes_of_flop,
)
from hyperpaint.simulation.rendering.platforms import platform_from_poses
from hyperpaint.simulation.rendering.scene import Scene, box, plane
from hyperpaint.simulation.rendering.scene_spectra import generate_paint, paint_spec, spectrum_of

GREY, OTHER = Material("grey", "panel_20", "panel"), Material("grey", "panel_50", "panel")
PAINT = Material("m", "m", "paint", Coat(), Flakes(0.15))
BARE = Material("m", "m", "paint", Coat())
TRIANGLE = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]
VISIBLE = np.array([380.0, 780.0])
GRID = np.arange(400.0, 1001.0, 5.0)
SERIES = irradiance_series(1)
NO_SERIES = SERIES.drop_vars("irradiance")


def stored(**changes: Any) -> Atmosphere:
    """Read an atmosphere from a dataset without, or with other, variables and attributes."""
    dataset = Atmosphere.clear(50.0, wavelength=GRID).to_dataset()
    dataset = dataset.drop_vars(changes.pop("drop", []))
    dataset["sky"].attrs.update(changes.pop("sky_attrs", {}))
    return Atmosphere.from_dataset(dataset.assign_attrs(changes))


def measured(*given: Any, **options: Any) -> Atmosphere:
    return Atmosphere.from_irradiance(irradiance_series(*given), sun_zenith=60.0, **options)


def of_columns(columns: Any) -> Atmosphere:
    return Atmosphere.from_table(columns, sun_zenith=30.0)


def of_grid(grid: Any) -> Atmosphere:
    same = np.zeros_like(np.asarray(grid, dtype=float))
    return Atmosphere(grid, same, same, same, same, 30.0, 0.0)


NO_SPECTRA = ("", "rad", "pigment:solid", "pigment:solid:-1", "pigment:solid:1e3", "pigment:gold:1",
              "pigment:solid:1:", "pigment:solid:\u0663")  # fmt: skip
NO_GRIDS = (
    [],
    [500.0],
    [[1.0, 2.0]],
    [500.0, 500.0],
    [500.0, 400.0],
    [-1.0, 5.0],
    [1.0, np.inf],
    [4.0, np.nan],
)

REFUSED: list[tuple[type[PaintError], str, Callable[..., Any], tuple[Any, ...], dict[str, Any]]] = [
    # materials
    (SchemaError, "option-conflict", base_albedo, (0.3,), {"geometry": "0/45", "specular_included": True}),
    (SchemaError, "value-out-of-range", base_albedo, ([5.0, 30.0],), {}),
    (SchemaError, "1 of 2.*not-finite", base_albedo, ([np.nan, 30.0],), {}),
    (SchemaError, "choice-unknown", base_albedo, (0.5,), {"geometry": "8/d"}),
    *((SchemaError, "index", Coat, (index,), {}) for index in (1.0, 0.5, 4.0, np.nan)),
    *((SchemaError, "share", Flakes, (share,), {}) for share in (-0.1, np.nan)),
    (SchemaError, "roughness", Flakes, (0.5, 0.0), {}),
    (SchemaError, "option-conflict", Material, ("leaf", "leaf", "leaf", Coat(), None, "leaf_through"), {}),
    # paints
    *((SchemaError, "spectrum-unknown", spectrum_of, (name,), {}) for name in NO_SPECTRA),
    *((SchemaError, "paint-unknown", paint_spec, (name,), {}) for name in (*NO_SPECTRA, "fleet-x")),
    (SchemaError, "'asphalt'.*spectrum-unknown", spectrum_of, ("asfalt",), {}),
    (SchemaError, "paint-unknown", paint_spec, ("pigment:pearl:3:flakes",), {}),
    (SchemaError, "family.*choice-unknown", generate_paint, ("gold", 1), {}),
    *((SchemaError, "value-out-of-range", generate_paint, ("solid", n), {}) for n in (-1, 10**9)),
    (SchemaError, "value-out-of-range", coat_of_gloss, (95.0,), {}),
    (SchemaError, "value-out-of-range", flakes_of_flop, (16.0, PAINT, VISIBLE, 0.6, 0.85), {}),
    (SchemaError, "flakes-missing", flakes_of_flop, (9.0, BARE, VISIBLE, 0.6, 0.85), {}),
    # scenes
    (SchemaError, "argument-missing", Scene.from_arrays, (TRIANGLE, [[0, 1, 2]], [GREY, PAINT]), {}),
    (SchemaError, "name-duplicate", Scene.join, ([plane(1.0, GREY), plane(1.0, OTHER, instance="b")],), {}),
    (SchemaError, "box.*name-duplicate", Scene.join, ([box((1, 1, 1), GREY)] * 2,), {}),
    (SchemaError, "fleet='rusty'", car_park, (), {"fleet": "rusty"}),
    (SchemaError, "time is not an array", platform_from_poses, (["a", "b"], *[[0] * 2] * 6), {"columns": 2}),
    # light
    *((SchemaError, "wavelength", of_grid, (grid,), {}) for grid in NO_GRIDS),
    *((SchemaError, "wavelength", Atmosphere.clear, (30.0,), {"wavelength": grid}) for grid in NO_GRIDS),
    *(
        (SchemaError, "sun_zenith", Atmosphere.clear, (zenith,), {"wavelength": GRID})
        for zenith in (-1.0, 89.5, 95.0, np.nan)
    ),
    (SchemaError, "choice-unknown", preset_atmosphere, ("midnight",), {}),
    (UnitsError, "'sky'", stored, (), {"sky_attrs": {"units": "W m-2 sr-1 nm-1"}}),
    (SchemaError, "'sun'.*\n.*'sun_zenith'", stored, (), {"drop": ["sun", "sun_zenith"]}),
    *(
        (SchemaError, "metadata-damaged", stored, (), {"haze": text})
        for text in ("{", "[1]", '{"fog": 1}', '{"visibility": "far"}')
    ),
    # light of a spectrometer
    *(
        (SchemaError, "direct_fraction", measured, (1,), {"direct_fraction": fraction})
        for fraction in (-0.1, 1.1, np.nan, [0.5, 0.5])
    ),
    (SchemaError, "irradiance", measured, (1, "W m-2 sr-1 nm-1"), {}),
    (SchemaError, "missing", Atmosphere.from_irradiance, (NO_SERIES,), {"sun_zenith": 1.0}),
    (SchemaError, "argument-missing", measured, (3,), {}),
    *(
        (SchemaError, "irradiance-coverage", measured, (count,), {"time": f"2020-06-21T{time}"})
        for count, time in ((3, "16:59:59"), (3, "17:00:21"), (0, "17:00:00"))
    ),
    *((SchemaError, "time-unreadable", measured, (3,), {"time": time}) for time in ("noon", "NaT", object())),
    (
        SchemaError, "wavelength-unordered", Atmosphere.from_irradiance,
        (SERIES.isel(irradiance_wavelength=slice(None, None, -1)),), {"sun_zenith": 1.0},
    ),
    # tables
    (FormatError, "length-mismatch", of_columns, ({},), {}),
    (FormatError, "number-unreadable", of_columns, ({"wavelength [nm]": "abc"},), {}),
    (FormatError, "length-mismatch", of_columns, ({"wavelength [nm]": [1, 2], "sun [W m-2 nm-1]": [1]},), {}),
    (FormatError, "length-mismatch", of_columns, ({"wavelength [nm]": 1.0},), {}),
    (FormatError, "heading-unreadable", of_columns, ({3: [1, 2]},), {}),
    (FormatError, r"none\.csv", of_columns, (Path("folder/none.csv"),), {}),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "words", "call", "arguments", "options"), REFUSED)
def test_refused(
    kind: type[PaintError],
    words: str,
    call: Callable[..., Any],
    arguments: tuple[Any, ...],
    options: dict[str, Any],
) -> None:
    with pytest.raises(kind, match=words):
        call(*arguments, **options)


def test_grids_beyond_spectrl2_are_refused() -> None:
    pytest.importorskip("pvlib")
    with pytest.raises(SchemaError, match=r"SPECTRL2.*value-out-of-range"):
        Atmosphere.spectrl2(30.0, wavelength=[200.0, 500.0])


def test_all_problems_of_a_material_at_once() -> None:
    with pytest.raises(SchemaError) as caught:
        Material("", "", "cheese", flakes=Flakes(0.5))
    for part in ("name is empty", "spectrum is empty", "'cheese'", "coat-missing"):
        assert part in str(caught.value)
    # labels count on the order of kinds
    assert KINDS[:3] == ("asphalt", "paint", "glass")
    assert len(set(KINDS)) == len(KINDS) == 13
