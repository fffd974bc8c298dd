# SPDX-License-Identifier: Apache-2.0
"""Styles of QGIS (``.qml``): the colours and names that a raster layer is shown with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np

from quadtree_lss.onboard.arrays import Bytes

STOPS = range(0, 256, 5)
"""Of a table of 256 colours; QGIS draws straight lines between them."""


def write_classes(path: Path, classes: Mapping[int, tuple[str, str]]) -> None:
    """Of a layer of whole values: a name and a colour, ``#rrggbb``, for each."""
    look = {"type": "paletted", "band": "1", "opacity": "1", "alphaBand": "-1"}
    renderer = xml.Element("rasterrenderer", look)
    entries = xml.SubElement(renderer, "colorPalette")
    for value, (name, colour) in sorted(classes.items()):
        about = {"value": str(value), "label": name, "color": colour, "alpha": "255"}
        xml.SubElement(entries, "paletteEntry", about)
    _write(path, renderer)


def write_ramp(path: Path, table: Bytes, limits: tuple[float, float], unit: str = "") -> None:
    """Of a layer of numbers.

    Args:
        path: To write.
        table: (256, 3) colours from the lower limit to the upper one; beyond, those at the ends.
        limits: Lower and upper.
        unit: For the legend; ``%`` shows shares of 1 as per cent.
    """
    low, high = (repr(float(limit)) for limit in limits)
    look = {"type": "singlebandpseudocolor", "band": "1", "opacity": "1", "alphaBand": "-1"}
    renderer = xml.Element(
        "rasterrenderer", {**look, "classificationMin": low, "classificationMax": high}
    )
    kind = {"colorRampType": "INTERPOLATED", "classificationMode": "1", "clip": "0"}
    ends = {"minimumValue": low, "maximumValue": high}
    shader = xml.SubElement(
        xml.SubElement(renderer, "rastershader"), "colorrampshader", kind | ends
    )
    for stop, value in zip(STOPS, np.linspace(*limits, len(STOPS)), strict=True):
        label = f"{100.0 * value:.3g} %" if unit == "%" else f"{value:.3g} {unit}".strip()
        colour = "#" + table[stop].tobytes().hex()
        about = {"value": repr(float(value)), "label": label, "color": colour, "alpha": "255"}
        xml.SubElement(shader, "item", about)
    _write(path, renderer)


def _write(path: Path, renderer: xml.Element) -> None:
    root = xml.Element("qgis", {"version": "3.22", "styleCategories": "Symbology"})
    xml.SubElement(root, "pipe").append(renderer)
    xml.indent(root, " ")
    head = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
    path.write_text(head + xml.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
