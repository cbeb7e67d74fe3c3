"""Synthetic scenes: geometry is traced once, spectra are applied later.

A path of light contributes ``w E_source(lambda) / pi x product of reflectances(lambda)``, and ``w`` does not
depend on wavelength. `relighting.trace` records the weights, `relighting.relight` turns them into radiance
for any paints, atmosphere and camera.

Scenes, flights, light and paints come in; traced weights and flight lines with their truth go out.
`simulation`, `workflows.rendering` and users call it. The modules, in the order of their imports:

The scene
    `materials` with their spectra and paints (`scene_spectra`); `scene`, triangles of materials, and shapes
    as tables of parts; `car_parks` of such shapes; `mesh_files` reads a scene.
The light
    `four_curves`, the atmosphere, from the simulator's sky, a spectrometer or a table.
The camera
    `platforms` and their flights.
Tracing and relighting
    `scene_record` (attributes of a traced dataset), `relighting` (tracing, spectra of all factors, light).
"""
