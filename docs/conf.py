"""Settings of the documentation: `make docs` builds it offline, warnings are errors."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [
    str(path) for path in (ROOT, ROOT / "hardware", ROOT / "hardware" / "pi", HERE / "tools")
]

import sorojax  # noqa: E402  (found on the path above)

project = "sorojax"
author = "The sorojax authors"
copyright = "the sorojax authors, MIT licence"
version = release = sorojax.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx_design",
    "sphinx_copybutton",
    "myst_nb",
    "sphinx_pages",
]
exclude_patterns = [
    "_build",
    "_generated/*.md",
    "_generated/tutorials",
    "tools",
    "**.ipynb_checkpoints",
]
default_role = "literal"
smartquotes_action = "D"  # dashes, no quotation marks

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "attrs_block"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_mime_priority_overrides = [("html", "image/png", 0)]

autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
napoleon_numpy_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False
napoleon_custom_sections = ["Reference", ("Attributes", "params_style")]
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_title = "sorojax"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "navbar_align": "left",
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 9,
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
}
html_sidebars = {"index": [], "gallery": [], "validation": [], "benchmarks": []}
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True
