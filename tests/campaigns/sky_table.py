"""``hyperpaint/light/clear_sky.npz`` from the tables of DISORT and of gases in ``../shared/data/sky_disort``.

``PYTHONPATH=tests python -m campaigns.sky_table`` writes it. The README beside the tables says how they were
made: own runs of libRadtran 2.0.2 (scattering, oxygen A line by line) and of SMARTS 2.9.5 (other gases).
Stored are the smooth quotients that are interpolated, in place of transmittances and radiances.
"""

from pathlib import Path

import numpy as np
from scipy.io import netcdf_file

from hyperpaint.light import clear_sky

SOURCE = Path(__file__).parents[2].parent / "shared/data/sky_disort/sky_disort.nc"
#: Names in the file of the tables, by names in the package's file.
AXES = {
    "rayleigh": "rayleigh_optical_depth", "aerosol": "aerosol_optical_depth", "sun": "sun_zenith_angle",
    "zenith": "zenith_angle", "azimuth": "relative_azimuth_angle", "mass": "mass", "water": "water",
    "path_depth": "path_depth", "path_wavelength": "wavelength", "path_aerosol": "path_aerosol",
    "path_sun": "path_sun", "line": "line",
}  # fmt: skip
GASES = {
    "water_depth": "water_slant_depth", "oxygen_depth": "oxygen_slant_depth",
    "continuum": "continuum_depth", "ozone": "ozone_absorption", "diffuse_air_mass": "diffuse_air_mass",
    "ground_to_sky": "ground_to_sky_radiance",
}  # fmt: skip


def main() -> None:
    with netcdf_file(SOURCE, mmap=False) as file:
        tables = {name: np.array(variable[:], np.float64) for name, variable in file.variables.items()}
    arrays = {name: tables[original].astype(np.float32) for name, original in (AXES | GASES).items()}
    depths = np.meshgrid(*(tables[AXES[axis]] for axis in ("rayleigh", "aerosol", "sun")), indexing="ij")
    level = np.cos(np.radians(depths[2]))
    cosine = np.cos(np.radians(tables["zenith_angle"]))[:, None]
    azimuth = np.radians(tables["relative_azimuth_angle"])
    for model, (albedo, asymmetry) in clear_sky.AEROSOL_MODELS.items():
        suffix = "" if model == "rural" else f"_{model}"
        transmittance = tables["diffuse_transmittance" + suffix]
        arrays[f"diffuse_{model}"] = np.log(transmittance / clear_sky.scattered_share(*depths)).astype(
            np.float32
        )
        once = clear_sky.scattered_once(
            *(depth[..., None, None] for depth in depths), cosine, azimuth, albedo, asymmetry
        )
        quotient = tables["sky_radiance" + suffix] / (once + (transmittance * level / np.pi)[..., None, None])
        arrays[f"radiance_{model}"] = np.rint(np.log(quotient) / clear_sky.RADIANCE_STEP).astype(np.int16)
        # quadratic through three nodes of asymmetry and of single-scattering albedo
        factor = tables["spherical_albedo_factor"]
        for axis, at in (("single_scattering_albedo", albedo), ("asymmetry_factor", asymmetry)):
            nodes = tables[axis]
            weights = [
                np.prod([(at - other) / (node - other) for other in nodes if other != node]) for node in nodes
            ]
            factor = np.tensordot(weights, factor, 1)
        arrays[f"spherical_albedo_{model}"] = (factor * tables["spherical_albedo"]).astype(np.float32)
    np.savez_compressed(Path(clear_sky.__file__).with_name("clear_sky.npz"), **arrays)


if __name__ == "__main__":
    main()
