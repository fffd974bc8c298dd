# SPDX-License-Identifier: Apache-2.0
"""Pictures of one simulated flight: `python docs/pictures.py --figure docs/images`."""

import argparse
import tempfile
from pathlib import Path

from PIL import Image

from quadtree_lss.api import load_config, replay
from quadtree_lss.lab.evaluation.evaluate import evaluate
from quadtree_lss.lab.simulation.simulate import simulate

PICTURES = {
    "quadtree.png": "evaluation/fig18_quadtree_over_truth.png",
    "hazards.png": "figures/hazards.png",
}
SCANNED = {"domain.xmin": -16.0, "domain.ymin": -16.0, "domain.size": 32.0}
SCANNED |= {"domain.min_level": 3, "domain.max_level": 7}  # the same cells: 4 ... 0.25 m


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
        evaluate(folder / "out", folder / "truth.npz", folder / "out" / "evaluation")
        for picture, source in PICTURES.items():
            with Image.open(folder / "out" / source) as image:
                small = image.convert("RGB").resize([3 * side // 4 for side in image.size])
                small.quantize(64, kmeans=1).save(arguments.figure / picture, optimize=True)


if __name__ == "__main__":
    main()
