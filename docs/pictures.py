# SPDX-License-Identifier: Apache-2.0
"""Pictures of simulated flights and of the elevation model of its tutorial.

`python docs/pictures.py --figure docs/images` draws them; those of the page need Chromium.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from quadtree_lss.api import load_config, replay
from quadtree_lss.desk.report import figures as drawing
from quadtree_lss.desk.report.palette import colour_limits
from quadtree_lss.lab.evaluation.results import load_results, load_truth
from quadtree_lss.lab.simulation.simulate import simulate

PICTURES = {
    "quadtree.png": "quadtree.png",
    "hazards.png": "figures/hazards.png",
}
#: Views of a page, by the end of its address.
VIEWS = {"report.png": "", "page_3d.png": "#mode=scene&site=1"}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1400,875")
FLAGS += ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
FLAGS += ("--virtual-time-budget=20000",)
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


def save(source, file, scale=1.0):
    """Save a picture with 64 colours."""
    with Image.open(source) as image:
        small = image.convert("RGB").resize([round(scale * side) for side in image.size])
        small.quantize(64, kmeans=1).save(file, optimize=True)


def flight_pictures(folder, figures, seed):
    """Draw four seconds of a flight of Section VII."""
    simulate("morpheus", folder / "bag", seed=seed, duration=4.0)
    replay(folder / "bag", folder / "out", load_config(["morpheus"], SCANNED))
    results, truth = load_results(folder / "out"), load_truth(folder / "truth.npz")
    (folder / "out" / "quadtree.png").write_bytes(drawing.png(quadtree(results, truth)))
    for picture, source in PICTURES.items():
        save(folder / "out" / source, figures / picture, 0.75)


def page_pictures(folder, figures):
    """Show the page of a flight of Section VII in a browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)))
    simulate("morpheus", folder / "flight" / "bag", seed=2)
    replay(folder / "flight" / "bag", folder / "page", load_config(["morpheus"]))
    for picture, view in VIEWS.items():
        shot, page = folder / picture, f"{(folder / 'page' / 'report.html').as_uri()}{view}"
        subprocess.run([browser, *FLAGS, f"--screenshot={shot}", page], check=True)
        save(shot, figures / picture)


def model_picture(folder, figures):
    """Rank sites on the elevation model of the tutorial."""
    text = (Path(__file__).parent / "tutorials" / "elevation_model.md").read_text("utf-8")
    model = re.search(r"<<'EOF'\n(.*?)\nEOF", text, re.DOTALL)[1]
    command = re.search(r"^quadtree-lss (sites model.npz .*)$", text, re.MULTILINE)[1]
    program = Path(sys.executable).with_name("quadtree-lss")
    for words in ([sys.executable, "-c", model], [program, *command.split()]):
        subprocess.run(words, cwd=folder, stdout=sys.stderr, check=True)
    save(folder / "sites" / "figures" / "hazards.png", figures / "model.png", 0.75)


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figure", type=Path, required=True, help="folder")
    parser.add_argument("--seed", type=int, default=121)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        flight_pictures(Path(name), options.figure, options.seed)
        model_picture(Path(name), options.figure)
        page_pictures(Path(name), options.figure)


if __name__ == "__main__":
    main()
