"""Synthetic scenes: geometry is traced once, spectra are applied afterwards.

A path of light contributes ``w E_source(lambda) / pi x product of reflectances(lambda)``, and ``w`` does not
depend on wavelength. `tracing` records the weights, `relighting` turns them into radiance for any paints,
atmosphere and camera. The modules, in the order in which they build on one another:

What is seen
    `materials` and the paints of `pigments`, with their `spectra`; `scene`, triangles of materials;
    `primitives`, `car_bodies`, `surroundings` and `pavements`, of which `car_parks` makes a scene;
    `mesh_files` reads one (with `obj_files`, `glb_files`, `ply_files`).
The light
    `four_curves`, the atmosphere, from `clear_skies`, `clouds`, `haze` or `measured_light`.
The camera
    `rotations`, `platform_geometry` and the flights of `platforms`; `bands` and their `band_responses`.
Tracing
    `path_codes`, `scene_record` (what a traced dataset keeps of its scene), `tracing`.
Relighting
    `painting` (which spectrum every factor has), `spectral_products`, `lighting`, `truth_layers`,
    `sky_record` and `relighting`.
Elsewhere
    `mitsuba_scenes` hands a scene to another renderer.
"""
