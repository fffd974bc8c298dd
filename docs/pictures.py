# SPDX-License-Identifier: Apache-2.0
"""Pictures of one simulated flight: `python docs/pictures.py --figure docs/images`."""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from quadtree_lss.api import load_config, replay
from quadtree_lss.desk.report import drawing
from quadtree_lss.desk.report.palette import colour_limits
from quadtree_lss.lab.evaluation.results import load_results, load_truth
from quadtree_lss.lab.simulation.simulate import simulate

PICTURES = {
    "quadtree.png": "quadtree.png",
    "hazards.png": "figures/hazards.png",
}
SCANNED = {"domain.xmin": -16.0, "domain.ymin": -16.0, "domain.size": 32.0}
SCANNED |= {"domain.min_level": 3, "domain.max_level": 7}  # the same cells: 4 ... 0.25 m


def quadtree(results, truth):
    """Leaf boundaries over the true elevation (the paper's Fig. 18)."""
    of = results.map.domain
    box = of.xmin, of.xmin + of.size, of.ymin, of.ymin + of.size
    figure, axes = _map("Quadtree over the true elevation", box)
    rows, columns = np.abs(truth.y) <= box[3], np.abs(truth.x) <= box[1]
    z = truth.elevation[np.ix_(rows, columns)]
    where = truth.x[columns], truth.y[rows], z
    shown = drawing.layer(axes, *where, limits=colour_limits(z))
    figure.colorbar(shown, ax=axes, label="true elevation [m]", extend="both")
    drawing.outline(axes, results.map, alpha=0.4)
    return figure


def _map(title, box):
    figure = Figure(figsize=(7.6, 6.6), layout="constrained")
    axes = figure.add_subplot()
    drawing.map_axes(axes, title, box)
    return figure, axes


def main() -> None:
    """Draw the pictures from four seconds of a flight of Section VII."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figure", type=Path, required=True, help="folder")
    parser.add_argument("--seed", type=int, default=121)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate("morpheus", folder / "bag", seed=arguments.seed, duration=4.0)
        replay(folder / "bag", folder / "out", load_config(["morpheus"], SCANNED))
        results, truth = load_results(folder / "out"), load_truth(folder / "truth.npz")
        (folder / "out" / "quadtree.png").write_bytes(drawing.png(quadtree(results, truth)))
        for picture, source in PICTURES.items():
            with Image.open(folder / "out" / source) as image:
                small = image.convert("RGB").resize([3 * side // 4 for side in image.size])
                small.quantize(64, kmeans=1).save(arguments.figure / picture, optimize=True)


if __name__ == "__main__":
    main()
