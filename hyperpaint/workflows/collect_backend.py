"""Entry point of xarray for collects; in this room because opening one may calibrate a lab sweep.

xarray loads this module at a user's first `open_dataset`: it imports nothing but xarray.
"""

import os
from typing import TYPE_CHECKING, Any, ClassVar

from xarray.backends import BackendEntrypoint

from hyperpaint.io.backends import first_bytes, local_path

if TYPE_CHECKING:
    import xarray as xr


class CollectBackendEntrypoint(BackendEntrypoint):
    # Opens a ``collect.toml``: ``xr.open_datatree("collect.toml")``, or ``engine="hyperpaint"``.
    #
    # See `hyperpaint.open_collect` for the returned tree.
    description: ClassVar[str] = "Collects (collect.toml) through hyperpaint"
    supports_groups: ClassVar[bool] = True
    open_dataset_parameters: ClassVar[tuple[str, ...]] = (
        "filename_or_obj",
        "drop_variables",
        "group",
        "need_irradiance",
    )

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        # Return whether this is a TOML file with a table of flight lines.
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        path = local_path(filename_or_obj)
        is_toml = path.suffix.lower() == ".toml"
        return is_toml and b"[flightlines" in first_bytes(path, 2**16).replace(b" ", b"")

    def open_datatree(
        self, filename_or_obj: Any, *, drop_variables: Any = None, need_irradiance: bool = True
    ) -> "xr.DataTree":
        # Open all files of the collect; see `hyperpaint.open_collect` for the options and the errors.
        from .collects import open_collect

        tree = open_collect(filename_or_obj, need_irradiance=need_irradiance)
        dropped = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        return (
            tree.map_over_datasets(lambda node: node.drop_vars(dropped, errors="ignore")) if dropped else tree
        )

    def open_groups_as_dict(self, filename_or_obj: Any, **options: Any) -> "dict[str, xr.Dataset]":
        # Open all files of the collect, as datasets by group.
        return {
            path: node.to_dataset()
            for path, node in self.open_datatree(filename_or_obj, **options).to_dict().items()
        }

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: Any = None,
        group: str | None = None,
        need_irradiance: bool = True,
    ) -> "xr.Dataset":
        # Open one group, such as ``flightlines/raw_0``.
        #
        # Raises `SchemaError`: The collect has no such group, or none was named; those that exist are listed.
        from hyperpaint.base.errors import SchemaError

        groups = {
            node.path.lstrip("/"): node
            for node in self.open_datatree(
                filename_or_obj, drop_variables=drop_variables, need_irradiance=need_irradiance
            ).subtree
            if node.has_data
        }
        SchemaError.raise_if(
            (name := (group or "").strip("/")) not in groups,
            f"group {group!r} of a collect",
            expected=f"one of {', '.join(sorted(groups))}",
            mend="name one of them, or open all by xarray.open_datatree",
            code="group-missing",
        )
        return groups[name].to_dataset()
