"""The site: pages of this folder, the notebooks as a gallery, and a page for every public name.

python -m pip install -e '.[docs]'
python -m sphinx -W --keep-going -b html docs docs/_build                  everything; runs the notebooks
python -m sphinx -b html -D nb_execution_mode=off docs docs/_build         without running them, a minute
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import sphinx_autosummary_accessors

import hyperpaint

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
sys.modules["hyperpaint.errors"] = hyperpaint.errors  # a name of hyperpaint.base.errors, no module of its own

from public_names import write_reference  # noqa: E402  (beside this file)

project, author, release = "hyperpaint", "the hyperpaint developers", hyperpaint.__version__
copyright = f"2026, {author}"
extensions = [
    "mathml", "myst_nb", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode", "sphinx_autosummary_accessors", "sphinx_copybutton",
    "sphinx_design",
]  # fmt: skip
templates_path = [sphinx_autosummary_accessors.templates_path]
exclude_patterns = ["_build", "jupyter_execute", "README.md"]
default_role = "py:obj"

myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["config.cache"]

# the gallery is run when the site is built, so that no output is older than its code
nb_execution_mode = "force"
# where the notebook of real files finds them: beside the clone, as the tests do
os.environ.setdefault("HYPERPAINT_REAL_DATA", str(HERE.parents[1] / "shared" / "data"))
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True

autosummary_generate = True
autodoc_typehints = "none"  # numpydoc has them, with units and dims
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

# off by default: a page is built without the network, and links into other projects are text then
intersphinx_mapping: dict[str, Any] = {}

html_math_renderer = "mathml"  # of mathml.py beside this file: no equation waits for a server
html_theme = "pydata_sphinx_theme"
html_title = "hyperpaint"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {
    "logo": {"text": "hyperpaint"},
    "show_toc_level": 2,
    "navigation_with_keys": True,
    "show_prev_next": True,
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"index": []}
html_show_sourcelink = False

# anchors of the code hosts are made by scripts, and DOIs send browsers on
linkcheck_anchors = False
linkcheck_allowed_redirects = {r"https://doi\.org/.*": r".*"}


def _copy_notebooks(target: Path) -> None:
    """Copy the notebooks, whose folder lies beside this one, to where Sphinx looks."""
    target.mkdir(exist_ok=True)
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        copy = target / notebook.name
        if not copy.exists() or copy.read_bytes() != notebook.read_bytes():
            shutil.copyfile(notebook, copy)


#: A link from a source back to the page of a name: file, the dotted name, the last of it, what is inside.
_BACK = re.compile(r"(generated/(hyperpaint\.(?:\w+\.)*(\w+))\.html)#hyperpaint\.(?:\w+\.)*?\3((?:\.\w+)*)\"")


def _mend_source_links(app: Any, page: str, template: str, context: dict[str, Any], tree: Any) -> None:
    """Give links back from sources the anchors of their pages: viewcode knows one room of a file."""
    if page.startswith("_modules/"):
        context["body"] = _BACK.sub(r'\1#\2\4"', context["body"])


def setup(app: Any) -> None:
    """Write what is made of other files before Sphinx reads its own."""
    app.connect("html-page-context", _mend_source_links)
    _copy_notebooks(HERE / "gallery")
    write_reference(HERE / "reference")
