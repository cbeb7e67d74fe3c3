"""A flight over a ray-traced car park of triangles, along the moving line of sight of the camera.

Paths of light are recorded without spectra; a table has the integrals INT E_k PROD rho R with the camera's
responses for every kind of path. The code of a path contains its source, so that direct and diffuse light
vary independently in time. The air between ground and camera neither absorbs nor scatters.
"""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Floats

from .atmosphere import CIE_OVERCAST_SHARE, clear_spread
from .camera import BandSet
from .flight import Flight, Layer, Lines, LineView
from .rendering.car_parks import car_park
from .rendering.four_curves import Atmosphere
from .rendering.materials import reflectance_factor
from .rendering.platforms import Platform, pixel_edges
from .rendering.relighting import (
    PreparedScene,
    ProductTable,
    factor_spectra,
    populations_of,
    prepare_scene,
    source_spectra,
    trace_block,
)
from .rendering.scene import Scene
from .rendering.scene_record import SceneRecord, TraceSettings, label_layers
from .rendering.scene_spectra import paint_spec, spectrum_of
from .settings import PIXEL_ANGLE_RAD, SWATH_M, SimulationSettings
from .transport.mixing import member_rows
from .transport.path_codes import is_direct, is_indirect, is_mirrored
from .transport.paths import Block

#: Reflectance added by the sun mirrored in a clear coat, above which a pixel is glint [1].
GLINT = 0.02

_MAX_LENGTH_M = 2000.0  # maximum length of the car park
_MARGIN_BEFORE_M = 3.0  # minimum length of car park before and behind the imaged area
_PANEL_PERIOD_M = 30.0  # distance of repeated grey panels, with which a flight starts
_GROUND_MARGIN_M = 30.0  # ground around the car park
_MIN_LEAN_DEG = 0.5  # minimum angle assumed between camera axis and vertical
_SKY_RINGS = 12  # parts of the sky that light a sample of a field spectrometer
_LINES_AT_ONCE = 4  # lines traced by a thread at once


class RenderedFlight(Flight):
    """A flight over a car park of triangles.

    Raises
    ------
    SchemaError
        The flight is longer than the maximum length of a car park.

    Examples
    --------
    >>> flight = RenderedFlight(SimulationSettings(lines=8, bands=4, columns=32, samples=2))
    >>> block = flight.lines(0, 8)
    >>> block.counts.shape, block.layers["purity"].shape
    ((8, 4, 32), (8, 32))
    """

    def __init__(self, settings: SimulationSettings) -> None:
        super().__init__(settings)
        scene = self._car_park()
        record = SceneRecord.of(scene)
        overcast = settings.sky == "overcast"
        trace = TraceSettings(
            (settings.sun,),
            samples=settings.samples,
            seed=settings.seed,
            overcast=overcast,
            clear=not overcast,
        )
        self._scene: PreparedScene = prepare_scene(scene, trace)
        spectra = [material.spectrum for material in record.materials]
        self.surfaces = tuple(dict.fromkeys(spectra))
        self.paints = tuple(
            sorted({material.spectrum for material in record.materials if material.kind == "paint"})
        )
        meters = {
            "east": f"East of the mean place seen, on {self.plane.crs}",
            "north": f"North of the mean place seen, on {self.plane.crs}",
            "height": "Mean height above the ellipsoid of what is seen",
            "up": "Mean height above the ground, a plane that touches it under the first line",
        }
        layers: dict[str, tuple[str, str, dict[str, Any]]] = {
            "surface_class": ("int16", "Kind of the surface", self._scene.labels["surface_class"].attrs),
            "paint_id": ("int16", "Paint of the car; -1 off paint", self._scene.labels["paint_id"].attrs),
            "car_id": ("int32", "Number of the car; -1 where there is none", {}),
            "purity": ("float32", "Share of the pixel that shows this surface", {"units": "1"}),
            "shadow": ("float32", "Share of the pixel that does not see the sun", {"units": "1"}),
            **{name: ("float64", text, {"units": "m"}) for name, text in meters.items()},
        }
        # Names of a fleet's paints by spectrum: "white solid", "white solid 2" ... along the flight, paints
        # in view first.
        middle = scene.vertices[scene.faces].mean(axis=1)[:, 1]
        end = self.settings.lines * self.ground_sample
        seen: dict[str, tuple[bool, float]] = {}
        for number, item in enumerate(scene.instances):
            if item.kind == "car":
                north = float(middle[scene.face_instance == number].mean())
                seen[item.paint] = min((not 0.0 <= north < end, north), seen.get(item.paint, (True, np.inf)))
        names: dict[str, str] = {}
        counts: Counter[str] = Counter()
        for paint in sorted(seen, key=seen.__getitem__):
            words = f"{paint_spec(paint).colour} {paint_spec(paint).finish}"
            counts[words] += 1
            numbered = f"{words} {counts[words]}" if counts[words] > 1 else words
            names[paint] = numbered if self.settings.fleet == "real" else paint
        self._seen = tuple(name for name, (_, y) in seen.items() if -self._ahead <= y <= end + self._ahead)
        self._names = names
        layers["paint_id"][2]["flag_meanings"] = " ".join(
            self.name_of(name).replace(" ", "_") for name in layers["paint_id"][2]["flag_meanings"].split()
        )
        # convert arrays to lists, because attributes are written as JSON
        self.layers = {
            name: Layer(dtype, {"long_name": text} | {k: np.asarray(v).tolist() for k, v in attrs.items()})
            for name, (dtype, text, attrs) in layers.items()
        }
        self._surface = np.array([self.surfaces.index(name) for name in spectra], np.int16)
        self._cosine = float(np.cos(np.radians(settings.sun[0])))
        bands = BandSet.of(self.imager)
        # light without path radiance and with unit transmittance
        direct, diffuse = self.sky
        atmosphere = Atmosphere(
            self.grid,
            direct / self._cosine,
            diffuse,
            0.0 * self.grid,
            0.0 * self.grid,
            *settings.sun,
            overcast_share=CIE_OVERCAST_SHARE if overcast else 0.0,
            **clear_spread(self.grid, direct, settings.sun[0]),
        )
        factors = factor_spectra(record, bands)
        self._populations = populations_of(record, factors, bands)
        self._products = ProductTable(
            bands, self._scene.codes, self.grid, source_spectra(atmosphere, trace), factors, normalise=False
        )

    def name_of(self, spectrum: str) -> str:
        return self._names.get(spectrum, spectrum)

    @property
    def measured_paints(self) -> tuple[str, ...]:
        return tuple(paint for paint in self._names if paint in self._seen)

    def paint_reflectance(self, names: Sequence[str], wavelength: Floats) -> Floats:
        # Reflectance factors of level paints, seen from the nadir under the flight's sun and sky, without
        # mirror reflection, shape (name, wavelength).
        direct, diffuse = (np.interp(wavelength, self.grid, light) for light in self.sky)
        # equal parts of the light of a uniform sky
        squared_sines = (np.arange(_SKY_RINGS) + 0.5) / _SKY_RINGS
        rings = np.degrees(np.arcsin(np.sqrt(squared_sines))).tolist()
        factors = []
        for name in names:
            body, paint = spectrum_of(name)(wavelength), paint_spec(name).material()
            if not self._flake_share(name) or paint.flakes is None:
                factors.append(body)
                continue
            flakes = spectrum_of(paint.flakes.spectrum)(wavelength)
            turned = spectrum_of(paint.flakes.turned)(wavelength) if paint.flakes.turned else None
            sun, *sky = (
                reflectance_factor(paint, body, flakes, light=zenith, view=0.0, turned=turned)
                for zenith in (self.settings.sun[0], *rings)
            )
            factors.append((direct * sun + diffuse * np.mean(sky, axis=0)) / (direct + diffuse))
        return np.stack(factors)

    def paint_properties(self, paint: str) -> Mapping[str, str]:
        # paints of a solid fleet have no flakes, also if their catalogue entry has flakes
        finish = paint_spec(paint).finish if self._flake_share(paint) else "solid"
        return {"colour": paint_spec(paint).colour, "finish": finish}

    def _flake_share(self, paint: str) -> float:
        # share of flakes in a paint of this scene
        flakes = paint_spec(paint).flakes if self.settings.fleet == "real" and self.settings.coat else None
        return 0.0 if flakes is None else flakes.share

    def clean_paint(self, lines: Lines) -> NDArray[np.int32]:
        # paint and car of pixels that show only one car's paint, in full sun and without glint; else -1
        paint, car = super().clean_paint(lines), np.asarray(lines.layers["car_id"], np.int32)
        is_clean = (paint >= 0) & (car >= 0)
        is_clean &= (lines.layers["purity"] == 1.0) & (lines.layers["shadow"] == 0.0)
        return np.where(is_clean, paint + len(self.paints) * car, -1).astype(np.int32)

    def _car_park(self) -> Scene:
        # the park starts before the view of the first line and ends behind that of the last line
        settings = self.settings
        # maximum distance ahead at which the camera looks, and length of park before its view [m]
        path = self.trajectory
        lean = float(np.tan(np.radians(max(_MIN_LEAN_DEG, path.steepest))))
        ahead = lean * self.ground_sample / PIXEL_ANGLE_RAD
        yaw_margin = float(np.sin(np.radians(path.max_yaw))) * SWATH_M / 2
        self._ahead = ahead + _MARGIN_BEFORE_M
        before = ahead + max(_MARGIN_BEFORE_M, yaw_margin + 1.0) + max(map(abs, path.lever_arm))
        start = np.ceil((before + ahead) / _PANEL_PERIOD_M) * _PANEL_PERIOD_M - ahead
        length = start + settings.lines * self.ground_sample + before
        SchemaError.raise_if(
            length > _MAX_LENGTH_M,
            f"{settings.lines} lines of {self.ground_sample:g} m need {length:.0f} m of car park",
            expected=f"at most {_MAX_LENGTH_M:g} m",
            mend="take fewer lines, more columns, or scene='plan'",
            code="flight-too-long",
        )
        park = car_park(
            length=float(length),
            width=SWATH_M,
            seed=settings.seed,
            neighbours=("trees", "walls", "lamps") if settings.neighbours else (),
            coat="own" if settings.coat else None,
            fleet=settings.fleet,
            # flakes only for the real fleet: a metallic paint has no single reflectance for a field
            # spectrometer
            flakes=settings.fleet == "real",
            margin=float(_GROUND_MARGIN_M + 2 * before),
            name="simulated car park",
        )
        return park.moved((0.0, -float(start), 0.0))

    @cached_property
    def platform(self) -> Platform:
        # camera poses at start and end of every exposure
        settings = self.settings
        moment = self.line_times[:, None] / 1e9 + settings.exposure_time * np.array([-0.5, 0.5])
        edges = pixel_edges(settings.columns, PIXEL_ANGLE_RAD)
        return Platform(*self.trajectory.camera(moment), *edges, self.line_times, settings.exposure_time)

    def _view(self, start: int, stop: int, into: Lines | None) -> LineView:
        platform = self.platform

        def trace(begin: int) -> Block:
            return trace_block(self._scene, platform, begin, min(begin + _LINES_AT_ONCE, stop))

        # threads run in parallel, because the kernel releases the interpreter lock
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            blocks = list(pool.map(trace, range(start, stop, _LINES_AT_ONCE)))
        block = Block(*map(np.concatenate, zip(*blocks, strict=True)))
        factors = self._factors(start, stop)
        latitude, longitude, height = self.frame.geodetic(np.moveaxis(block.position, 1, -1))
        east, north = self.plane.project(latitude, longitude)
        layers = {
            **label_layers(self._scene.labels, block.material, block.instance),
            "purity": block.purity,
            "shadow": 1.0 - block.sun_visibility[:, 0],
            "east": east,
            "north": north,
            "height": height,
            "up": block.position[:, 2],
        }
        # pixels in which mirrored sun adds more than `GLINT`, shape (line, column)
        mirrored = is_direct(block.code) & is_mirrored(block.code) & ~is_indirect(block.code)
        level = self.incident.mean(axis=(1, 2)) @ factors
        normal = self.incident[0].mean() / self._cosine * factors[0]
        glint = np.where(mirrored, block.weight, 0.0).sum(axis=1) * (normal / level)[:, None] > GLINT
        record = Lines(
            self._surface[block.material], np.asarray(glint), *self._cubes(stop - start, into), layers
        )
        # the array of radiance holds INT L R until counts are computed
        direct, diffuse = factors[:, :, None, None]
        weight = (block.weight * np.where(is_direct(block.code), direct, diffuse)).astype(np.float32)
        texture = None
        if self._populations is not None:
            members, (x, y, z) = self._populations, np.moveaxis(block.position, 1, 0)
            rows = member_rows(
                block.material, block.instance, x, y, z, block.incidence[:, 0],
                sun_zenith=self.settings.sun[0], grain=members.grain, seed=self.settings.seed,
            )  # fmt: skip
            texture = members.of_rows(rows)
        self._products.mix(weight, block.code, record.radiance, texture)
        per_element = np.pi * self.imager.element_factor
        return record, lambda row: record.radiance[row] * per_element
