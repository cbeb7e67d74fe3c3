"""The library that tests of this folder write."""

import pytest
import xarray as xr
from support.library_examples import make_library


@pytest.fixture
def library() -> xr.Dataset:
    return make_library()
