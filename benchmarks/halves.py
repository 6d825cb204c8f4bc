"""The factor and the band of `jaxphoto halves`, and how many cells of cuts that made no band lie within it.

python benchmarks/halves.py BLOCK_FOLDER [--cuts 64] [--fresh 64] [--by image]

Fresh cuts are at random, half of the images each: a cut that the band was made of is not among them.
"""

import argparse
from pathlib import Path

import numpy as np

import jaxphoto
from jaxphoto.adjustment import common_sizes
from jaxphoto.procedures.compare import camera_of, halved, halves
from jaxphoto.stability import image_grid


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("block", type=Path)
    parser.add_argument("--cuts", type=int, default=64)
    parser.add_argument("--fresh", type=int, default=64)
    parser.add_argument("--by", default="image")
    arguments = parser.parse_args()
    block = jaxphoto.read_block(arguments.block)
    camera = camera_of(block, None)
    cells = image_grid(block.sensors[camera])
    found = halves(block, cells, by=arguments.by, n_cuts=arguments.cuts)
    band, (inside, error) = found.band, found.inside
    print(f"factor {band.factor:.2f} +- {band.sigma_factor:.2f}, {_range(band.cell_factor)} over the format")
    print(f"95 % of the errors within {_range(band.calibration)} px, of differences {_range(band.halves)} px")
    print(
        f"cells within the band, {len(found.cuts)} cuts, each by the others: {100 * inside:.1f} +- {100 * error:.1f} %"
    )

    owner = np.array(block.owners(arguments.by), object)
    units = np.array(list(dict.fromkeys(owner)), object)
    used = {first.tobytes() for cut in (*found.cuts, *found.failed) for first in (cut.first, ~cut.first)}
    rng, sizes = np.random.default_rng(1), common_sizes([block])
    within, plain = [], []
    for _ in range(arguments.fresh):
        first = np.isin(owner, rng.permutation(units)[: len(units) // 2])
        if first.tobytes() in used:
            continue
        cut = halved(found.adjusted, first, camera, cells, found.method, sizes)
        if not cut.problem:
            size = np.linalg.norm(cut.offsets_px, axis=1)
            within.append((size <= band.halves).mean())
            plain.append((size <= band.halves / band.cell_factor).mean())
    for name, share in (("the band", within), ("the band without the factor", plain)):
        spread = np.std(share, ddof=1) / np.sqrt(len(share))
        print(f"cells of {len(share)} fresh cuts within {name}: {100 * np.mean(share):.1f} +- {100 * spread:.1f} %")


def _range(values: np.ndarray) -> str:
    return f"{values.min():.3g} to {values.max():.3g}"


if __name__ == "__main__":
    main()
