"""Sphinx's settings: `make docs` builds the site into docs/_build/html, without a network."""

from __future__ import annotations

import os
import socket
import sys
import warnings
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS / "_ext"), str(DOCS)]

os.environ.setdefault("OMP_NUM_THREADS", "2")
import docstrings  # noqa: E402
import long_scripts  # noqa: E402

import kcam  # noqa: E402

project, author = "kcam", "the kcam developers"
copyright = "2026, the kcam developers"
version = release = kcam.__version__
extensions = [
    "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.doctest", "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode", "sphinx-mathjax-offline", "myst_parser", "sphinx_copybutton", "sphinx_design",
    "sphinx_gallery.gen_gallery", "sphinxcontrib.bibtex", "docstrings", "thumbnails",
]  # fmt: skip
exclude_patterns = ["_build", "lessons", "recipes", "pictures", "**/GALLERY_HEADER.rst", "**.ipynb", "**.py", "**.md5"]
templates_path = ["_templates"]
default_role = "code"

# ---- pages -----------------------------------------------------------------------------------------------------------

myst_enable_extensions = ["dollarmath", "colon_fence", "attrs_block", "attrs_inline"]
myst_heading_anchors = 3
bibtex_bibfiles = ["references.bib"]
bibtex_default_style = "unsrt"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# ---- the reference ---------------------------------------------------------------------------------------------------

autosummary_ignore_module_all = False
autosummary_imported_members = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
doctest_test_doctest_blocks = ""  # tests/test_docstrings.py and tests/test_pages.py run them
REACHED = {
    "python": ("docs.python.org", "https://docs.python.org/3/"),
    "torch": ("docs.pytorch.org", "https://docs.pytorch.org/docs/stable/"),
    "kornia": ("kornia.readthedocs.io", "https://kornia.readthedocs.io/en/latest/"),
    "numpy": ("numpy.org", "https://numpy.org/doc/stable/"),
}


def reachable(host: str) -> bool:
    """Whether there is a network to fetch another project's names over."""
    try:
        socket.create_connection((host, 443), timeout=2).close()
    except OSError:
        return False
    return True


intersphinx_mapping = {name: (url, None) for name, (host, url) in REACHED.items() if reachable(host)}

# ---- scripts that are run --------------------------------------------------------------------------------------------

GALLERIES = {"lessons": "learn", "recipes": "do/recipes", "pictures": "gallery"}
sphinx_gallery_conf = {
    "examples_dirs": [*GALLERIES],
    "gallery_dirs": [*GALLERIES.values()],
    "doc_module": ("kcam",),
    "backreferences_dir": "reference/backreferences",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "remove_config_comments": True,
    "abort_on_example_error": True,
    "min_reported_time": 20,
    "show_signature": False,
    "thumbnail_size": (480, 336),
    "capture_repr": ("_repr_html_", "__repr__"),
    "ignore_repr_types": r"matplotlib\.|list|tuple|NoneType",
    "reset_modules": ("matplotlib",),
    "write_computation_times": False,
}
warnings.filterwarnings("ignore", message="Matplotlib is currently using agg")
long_scripts.check(DOCS)

# ---- how it looks ----------------------------------------------------------------------------------------------------

html_theme = "pydata_sphinx_theme"
html_title = "kcam"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 6,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
    "show_toc_level": 2,
    "logo": {"text": "kcam"},
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
html_sidebars = {"index": []}
html_context = {"default_mode": "auto"}  # else the theme logs an error

docstrings.write_reference(DOCS / "reference" / "api")
