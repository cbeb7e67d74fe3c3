"""The order of the rooms: one row a room."""

#: From the ground up: a room imports rooms below it.
ROOMS = (
    "base",
    "kernels",
    "io",
    "light",
    "simulation",
    "radiometry",
    "calibration",
    "alignment",
    "geometry",
    "surroundings",
    "plausibility",
    "regions",
    "paints",
    "validation",
    "pictures",
    "report",
    "workflows",
    "accessor",
    "__init__",
    "cli",
)
#: All that these may import: a loop closed through shared code proves nothing, readers hold no physics.
ALONE: dict[str, set[str]] = {
    "base": set(),
    "kernels": {"base"},
    "simulation": {"base", "light"},
    "io": {"base"},
    "paper": {"base"},
}
#: What the simulator may know of the light: the sky itself, which renderer and corrections must mean alike.
#: What the chain does with light (matching, splits, responses) it must not see.
SKY = {"light.sky_functions"}
