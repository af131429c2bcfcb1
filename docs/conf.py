"""How Sphinx builds the documentation: `make docs`. No page loads anything from a network."""

import os
import pathlib
import sys
import typing

typing.GENERATING_DOCUMENTATION = "jaxtyping"  # has jaxtyping show `Float[Array, "v 3"]` in place of classes

FOLDER = pathlib.Path(__file__).parent
sys.path[:0] = [str(FOLDER.parent), str(FOLDER / "_extensions")]

import jaxprt  # noqa: E402

project = "jaxprt"
author = copyright = "The jaxprt authors"
version = release = jaxprt.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_design",
    "mathml",
    "notebook_pages",
    "reference_pages",
]
exclude_patterns = ["_extensions", "**.ipynb_checkpoints"]

myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4  # the anchors of GitHub, so that links with # work there too
myst_links_external_new_tab = False
html_math_renderer = "mathml"

# Notebooks are shown as committed. JAXPRT_DOCS_EXECUTE=1 executes them; JAXPRT_NOTEBOOKS and JAXPRT_DATA say how.
nb_execution_mode = "force" if os.environ.get("JAXPRT_DOCS_EXECUTE") == "1" else "off"
nb_execution_timeout = 3600
nb_execution_raise_on_error = True
nb_merge_streams = True

default_role = "py:obj"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
maximum_signature_line_length = 88
python_use_unqualified_type_names = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # the signature of the class has the types

html_theme = "sphinx_book_theme"
html_title = "jaxprt"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["mathml.css"]
html_extra_path = ["live.html", "beside.html"]  # of the gallery
html_theme_options = {
    "use_download_button": False,
    "use_fullscreen_button": False,
    "show_navbar_depth": 1,
    "show_toc_level": 2,
}
html_use_opensearch = ""
