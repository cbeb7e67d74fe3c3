"""The site: pages of this folder, the notebooks as a gallery, and a page for every public name.

python -m pip install -e '.[docs]'
python -m sphinx -W --keep-going -b html docs docs/_build

The notebooks have their outputs; `python notebooks/refresh.py` runs them, with --check it compares.
"""

from __future__ import annotations

import base64
import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import sphinx_autosummary_accessors
import yaml

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

nb_execution_mode = "off"  # stored outputs are shown; notebooks/refresh.py compares them with new ones
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
html_logo = html_favicon = "_static/logo.svg"
html_theme_options = {
    "logo": {"text": "hyperpaint"},
    "show_toc_level": 2,
    "navigation_with_keys": True,
    "show_prev_next": True,
    "footer_start": ["copyright"],
    "footer_end": [],
}
# pages without a section have no navigation at their side
html_sidebars = {name: [] for name in ("index", "installation", "tour", "figures", "glossary", "changelog")}
html_show_sourcelink = False

# anchors of the code hosts are made by scripts, and DOIs send browsers on
linkcheck_anchors = False
linkcheck_allowed_redirects = {r"https://doi\.org/.*": r".*"}


def _copy_notebooks(target: Path) -> None:
    """Copy the notebooks to where Sphinx looks, and write a card for each: thumbnail, title, promise."""
    thumbnails = target / "thumbnails"
    thumbnails.mkdir(parents=True, exist_ok=True)
    grids: dict[str, list[str]] = {"gallery": [], "background": []}
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        shutil.copyfile(notebook, target / notebook.name)
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        title, promise = "".join(cells[0]["source"]).removeprefix("# ").split("\n\n")[:2]
        outputs = [
            one for cell in cells for one in cell.get("outputs", []) if "image/png" in one.get("data", {})
        ]
        card = [f":::{{grid-item-card}} {title}", f":link: {notebook.stem}", ":link-type: doc"]
        if outputs:
            png = "".join(outputs[0]["data"]["image/png"])
            (thumbnails / f"{notebook.stem}.png").write_bytes(base64.b64decode(png))
            card += [
                f":img-top: thumbnails/{notebook.stem}.png",
                f":img-alt: First picture of the page {title}",
            ]
        is_page = notebook.name[0].isdigit()
        grids["gallery" if is_page else "background"].append(
            "\n".join([*card, "", " ".join(promise.split()), ":::"])
        )
    for name, cards in grids.items():
        text = "\n\n".join(["::::{grid} 1 2 2 3", ":gutter: 3", *cards, "::::"]).replace(
            "3\n\n:gutter", "3\n:gutter"
        )
        (target / f"{name}.cards").write_text(text + "\n", encoding="utf-8")


def _write_citation(path: Path) -> None:
    """Write the BibTeX entries of CITATION.cff: the software, and the paper it starts from."""
    cff = yaml.safe_load((HERE.parent / "CITATION.cff").read_text(encoding="utf-8"))
    (paper,) = cff["references"]
    entries = {
        "software{hyperpaint": {
            "author": " and ".join("{" + each["name"] + "}" for each in cff["authors"]),
            "title": "{" + cff["title"] + "}",
            "version": cff["version"],
            "year": cff["date-released"].year,
        },
        "inproceedings{paint_signatures": {
            "author": " and ".join(
                f"{each['family-names']}, {each['given-names']}" for each in paper["authors"]
            ),
            "title": "{" + paper["title"] + "}",
            "booktitle": paper["collection-title"],
            "year": paper["year"],
        },
    }
    texts = [
        "@" + kind + ",\n" + "".join(f"  {key} = {{{value}}},\n" for key, value in fields.items()) + "}\n"
        for kind, fields in entries.items()
    ]
    path.write_text("\n".join(texts), encoding="utf-8")


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
    _write_citation(HERE / "gallery" / "citation.bib")
    write_reference(HERE / "reference")
