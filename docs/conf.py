# SPDX-License-Identifier: Apache-2.0
"""The site: `make docs`, and rosdoc2 by rosdoc2.yaml. Nothing is loaded from elsewhere."""

import os
import re

project = "quadtree_lss"
copyright = "quadtree_lss contributors, Apache-2.0"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["*.py", "*.txt"]
html_theme = "furo"
html_title = "quadtree_lss"
html_static_path = ["_static"]
html_css_files = ["site.css"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 4
myst_url_schemes = ["http", "https", "mailto"]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
rosdoc2_settings = {"override_theme": False}
suppress_warnings = ["config.cache"]

# Pages link to each other as they lie in the repository. Here the layouts of messages are in
# messages/, what concerns the project is in project/, and sources are named only.
PLACES = {"msg_docs/": "messages/", "docs/": ""}
PROJECT = ("CONTRIBUTING", "QUALITY_DECLARATION", "CHANGELOG")
PLACES |= {f"{name}.": f"project/{name}." for name in PROJECT}

# What figures.py reads, for people to read as well.
FIGURE = re.compile(r"<!-- figure: ([^\n]+)\n[^;]*;[^;=]*(?:= \w+)?; (build [^>]*|earlier) -->")


def move_links(app, page, source):
    """From a page's place in the repository to its place in the site."""
    up = "../" * page.count("/")
    home = {"messages": "msg_docs/", "project": ""}.get(page.partition("/")[0], f"docs/{page}/../")

    def moved(match):
        label, path = match.groups()
        path = os.path.normpath(home + path)
        for place, here in PLACES.items():
            if path.startswith(place):
                return f"[{label}]({up}{path.replace(place, here, 1)})"
        return label

    source[0] = FIGURE.sub(r"\n*Made by `\1`; \2*\n", source[0])
    if page == "messages/README":  # whose table names them all
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n[a-z]*\n```\n"
    source[0] = re.sub(r"(?<!!)\[([^][]*)\]\((?!\w+:|#)([^)\s]+)\)", moved, source[0])


def mathml(block):
    """Formulas as the browser's own MathML: no script, no network."""
    from docutils import nodes
    from docutils.utils.math.latex2mathml import tex2mathml

    def visit(writer, node):
        text = tex2mathml(node.astext(), as_block=block)
        writer.body.append(f'<div class="math">{text}</div>' if block else text)
        raise nodes.SkipNode

    return visit


def level_captions(app, page, template, context, doctree):
    """Sphinx's captions are headings, of which a screen reader asks the level."""
    for name in {"body", "furo_navigation_tree"} & context.keys():
        headings = 'role="heading"', 'role="heading" aria-level="2"'
        context[name] = context[name].replace(*headings)


def setup(app):
    app.connect("source-read", move_links)
    app.connect("html-page-context", level_captions, priority=900)
    app.add_html_math_renderer("mathml", (mathml(False), None), (mathml(True), None))


html_math_renderer = "mathml"
