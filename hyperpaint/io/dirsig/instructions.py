"""Texts of an export beside its spectra: materials, a fragment of a geometry list, instructions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from xml.sax.saxutils import escape, quoteattr

from hyperpaint.base.mirrored_light import INCLUDED

from .material_list import Section

#: Parameters of DIRSIG's temperature solver Therm; its keys are in capitals.
THERMAL = (
    "specific_heat",
    "mass_density",
    "thermal_conductivity",
    "solar_absorption",
    "thermal_emissivity",
    "exposed_area",
    "thickness",
)

_CURVES = {
    "members": "one curve for every pixel, from which DIRSIG's texture can draw",
    "quantiles": "one curve for every quantile of the pixels",
    "centre": "one curve, the centre of the pixels",
}


#: Settings of the radiometry solvers, as in files of DIRSIG's distribution.
_SOLVERS = {
    "Classic": (("ENABLE_SAMPLED_DIFFUSE", "FALSE"),),
    "Generic": (
        ("INITIAL_SAMPLE_COUNT", "100"),
        ("SAMPLE_DECAY_RATE", "2"),
        ("MAX_BOUNCES", "3"),
        ("MU_SAMPLES", "10"),
        ("PHI_SAMPLES", "20"),
        ("MIN_QUAD_SAMPLES", "1"),
    ),
}


def material_section(
    record: Mapping[str, Any],
    *,
    surface: str,
    rad_solver: str,
    thermal: Mapping[str, float] | None,
    double_sided: bool,
) -> Section:
    """Return the entry of one paint in a material list.

    ``record``: record of the paint in ``paints.json``; ``surface``: ``ClassicEmissivity``,
    ``SimpleReflectance``, or ``ShellTarget`` with a ``fit_file``; ``rad_solver``: name of the radiometry
    solver; ``thermal``: values of `THERMAL`, None if temperature is not computed; ``double_sided``: whether
    the back of a facet has the paint, too.
    """
    colour = ", ".join(f"{value:.3g}" for value in record["editor_color"])
    settings = _SOLVERS.get(rad_solver, ())
    values = tuple((key.upper(), f"{float(value):.6g}") for key, value in (thermal or {}).items())
    if surface == "ShellTarget":
        files = (("EMISSIVITY_FILE", record["emissivity_file"]), ("BRDF_FIT_FILE", record["fit_file"]))
        properties = Section("REFLECTANCE_PROP", files)
    elif surface == "ClassicEmissivity":
        fraction = f"{record['specular_fraction']:g}"
        files = (("FILENAME", record["emissivity_file"]), ("SPECULAR_FRACTION", fraction))
        properties = Section("EMISSIVITY_PROP", files)
    else:
        properties = Section("REFLECTANCE_PROP", (("TXT_FILENAME", record["reflectance_file"]),))
    return Section(
        "MATERIAL_ENTRY",
        (
            ("ID", record["id"]),
            ("NAME", record["name"]),
            ("EDITOR_COLOR", colour),
            ("DOUBLE_SIDED", "TRUE" if double_sided else "FALSE"),
            ("RAD_SOLVER_NAME", rad_solver),
            Section("RAD_SOLVER", settings),
            ("TEMP_SOLVER_NAME", "Therm" if thermal else "Null"),
            Section("TEMP_SOLVER", values),
            Section("SURFACE_PROPERTIES", ((f"{properties.name}_NAME", surface), properties)),
        ),
    )


def glist_text(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a geometry list with one object for every paint, side by side.

    ``car.obj`` and ``body`` are placeholders: the geometry, and the name of its painted part.
    """
    rows = [
        '<geometrylist enabled="true">',
        "  <!-- Replace car.obj by your geometry, and body by the material of its painted parts. -->",
    ]
    for number, record in enumerate(records):
        rows += [
            f"  <!-- {escape(record['name']).replace('--', '- -')} -->",
            "  <object>",
            "    <basegeometry>",
            "      <obj>",
            "        <filename>car.obj</filename>",
            f"        <assign id={quoteattr(record['id'])}>body</assign>",
            "      </obj>",
            "    </basegeometry>",
            "    <staticinstance>",
            f"      <translation><point><x>{4 * number}</x><y>0</y><z>0</z></point></translation>",
            "    </staticinstance>",
            "  </object>",
        ]
    return "\n".join([*rows, "</geometrylist>", ""])


def readme_text(records: Sequence[Mapping[str, Any]], attrs: Mapping[str, str]) -> str:
    """Return the README: how to add the paints to a scene, and the changes to their spectra."""
    first = records[0]
    return f"""Paints for DIRSIG
=================

{len(records)} paints, written by hyperpaint.

Files
-----
materials.mat          a MATERIAL_ENTRY for every paint
emissivity/<ID>.ems    emissivity = 1 - reflectance of an opaque paint (see "Clear coat");
                       {_CURVES[attrs["curves_of"]]}
reflectance/<ID>.txt   the centre of the paint: micrometre, reflectance (for SimpleReflectance)
paints.glist           a geometry list with one object a paint, to cut from
paints.json            names, ranges and counts of every paint

Adding a paint, step by step
----------------------------
1. Copy emissivity/{first["id"]}.ems to where the scene's emissivity files are. FILENAME in the
   material is relative to the folder in which DIRSIG looks for the scene's material properties.
2. Append its MATERIAL_ENTRY of materials.mat to the scene's own .mat file. Its ID
   ({first["id"]}) must not be there yet; write_dirsig(..., scene_materials="scene.mat") sees to that.
3. Give it to geometry, in the .glist of the car:
     <obj><filename>car.obj</filename><assign id="{first["id"]}">body</assign></obj>
   where body is the name of the material in the .obj file. For a car park of many paints, add the
   ID to the variants of the vehicles' glists; weights of a <basegeometry weight="2"> choose among
   them. In a bundle, the .mat stands beside the .glist, and <localmaterials> names it.
4. Name the .mat in the scene file: <matfilename>.
5. Check that the sensor's bands are inside the range below: DIRSIG needs all of them.
6. Run, and compare the reflectance of the painted parts with reflectance/{first["id"]}.txt.

Several curves
--------------
An .ems file with many curves is the variability within a paint. DIRSIG picks among them with a
texture map of the material (see "Classic Emissivity" and texture in its manual). materials.mat
names no map: which picture fits is up to the scene.{_thinned(records)}

Clear coat
----------
Mirrored light in the reflectance: {attrs["mirror_reflection"]} ({attrs["mirror_reflection_source"]}).
Specular term: {attrs["specular_term"]}.
{_coat_advice(attrs)}

What was done to the spectra
----------------------------
Values outside 0 to 1 were clipped to it, bands without values filled in by a straight line, and ends
held constant, only where the table says so: of the curves + of the centre (reflectance/<ID>.txt).

{_table(records)}
{_gaps(records)}"""


def _thinned(records: Sequence[Mapping[str, Any]]) -> str:
    # Sentence on curves above ``max_curves``, which are not written
    rows = [f"{record['id']} {record['thinned']}" for record in records if record["thinned"]]
    text = "\nLeft out since there were more than asked for, at even ranks of brightness: "
    return text + ", ".join(rows) + "." if rows else ""


_MAX_GAPS = 12


def _gaps(records: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for record in records:
        gaps = [f"{nm:.1f}" for nm in record["gaps"][:_MAX_GAPS]] + ["..."] * (
            len(record["gaps"]) > _MAX_GAPS
        )
        note = "; no member has values at both ends: the centre is the only curve" * record["is_centre"]
        if gaps or note:
            complete = f"{record['complete']} of {record['curves']} curves are complete, and come first"
            rows.append(
                f"{record['id']}: {complete}" + f"; filled in at {', '.join(gaps)} nm" * bool(gaps) + note
            )
    return "\n".join(["", "Gaps:", *rows, ""]) if rows else ""


def _coat_advice(attrs: Mapping[str, str]) -> str:
    if attrs["mirror_reflection"] == INCLUDED:
        return (
            "The curves hold what the clear coat mirrored when they were measured. SPECULAR_FRACTION is 0:\n"
            "do not raise it, and add no glossy property: the coat would count twice."
        )
    if attrs["specular_term"].startswith("none"):
        return (
            "The curves are the body below the coat. For a glossy paint write them again with specular=0.1\n"
            "or so, or specular='library': SPECULAR_FRACTION raised by hand takes its share from the body."
        )
    return (
        "The diffuse part, (1 - SPECULAR_FRACTION) x (1 - emissivity), is the body of the paint; the rest\n"
        "is the coat, of the body's colour, as ClassicEmissivity has one fraction for all wavelengths.\n"
        "This takes SPECULAR_FRACTION for the specular share of reflectance: check one paint first."
    )


def _both(record: Mapping[str, Any], key: str) -> str:
    return f"{record[key]} + {record[f'centre_{key}']}".rjust(11)


def _table(records: Sequence[Mapping[str, Any]]) -> str:
    width = max(2, *(len(record["id"]) for record in records))
    head = f"{'ID':<{width}}  {'range [nm]':>17}  curves      clipped    filled in  left out  extrapolated"
    rows = [
        f"{record['id']:<{width}}  {record['wavelength'][0]:8.2f} {record['wavelength'][1]:8.2f}  "
        f"{record['curves']:6d}  {_both(record, 'clipped')}  {_both(record, 'interpolated')}  "
        f"{record['left_out']:8d}  {record['extrapolated'] or 'no'}"
        for record in records
    ]
    names = [
        f"{record['id']}: {record['paint']!r} is called {record['name']!r}"
        for record in records
        if record["paint"] != record["name"]
    ]
    renamed = ["", "Names in plain ASCII, all different:", *names] if names else []
    return "\n".join([head, *rows, *renamed])
