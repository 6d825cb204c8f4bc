"""Orient photographs by COLMAP with other options than its own: images, image points, c and CPU seconds of each step.

python benchmarks/colmap_options.py FOLDER [--photographs N] [--longest-px N] [--seeds N] [--out DIR] [--set NAME=VALUE]

NAME is a field of pycolmap.IncrementalPipelineOptions, such as mapper.init_min_tri_angle. The models are written to
DIR/SEED; `jaxphoto convert DIR/SEED/0 BLOCK` and `jaxphoto adjust BLOCK --out RESULTS` give c beside its sigma.
"""

import argparse
import json
import resource
import tempfile
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photographs", type=int)
    parser.add_argument("--longest-px", type=int, default=-1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--set", nargs="*", default=[])
    arguments = parser.parse_args()
    import pycolmap

    pycolmap.logging.minloglevel = 2
    out = arguments.out or Path(tempfile.mkdtemp())
    out.mkdir(parents=True, exist_ok=True)
    files = sorted(f.name for f in arguments.folder.iterdir() if f.suffix.lower() in (".jpg", ".png", ".tif"))
    extraction, cpu = pycolmap.FeatureExtractionOptions(), pycolmap.Device.cpu
    extraction.max_image_size = arguments.longest_px
    record: dict = {}
    began = _cpu()
    pycolmap.extract_features(
        out / "database.db",
        arguments.folder,
        files[: arguments.photographs],
        pycolmap.CameraMode.SINGLE,
        extraction_options=extraction,
        device=cpu,
    )
    record["features"], began = _cpu() - began, _cpu()
    pycolmap.match_exhaustive(out / "database.db", device=cpu)
    record["matches"] = _cpu() - began
    for seed in range(arguments.seeds):
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed)
        for setting in arguments.set:
            name, _, value = setting.partition("=")
            *groups, field = name.split(".")
            target = options
            for group in groups:
                target = getattr(target, group)
            setattr(target, field, type(getattr(target, field))(float(value)))
        began = _cpu()
        (out / str(seed)).mkdir(exist_ok=True)
        models = pycolmap.incremental_mapping(out / "database.db", arguments.folder, out / str(seed), options).values()
        found = {"cpu": _cpu() - began, "images": [model.num_reg_images() for model in models]}
        if models:
            best = max(models, key=lambda model: model.num_reg_images())
            camera = next(iter(best.cameras.values()))
            found |= {"image points": best.compute_num_observations(), "c_px": camera.focal_length}
            found |= {"mean px": best.compute_mean_reprojection_error()}
        record[f"seed {seed}"] = found
    print(json.dumps(record, indent=2))


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
