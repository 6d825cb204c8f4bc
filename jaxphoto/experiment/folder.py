"""Experiments on disk: found by name, run, and written down whole."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pandas as pd

from jaxphoto.errors import InputError
from jaxphoto.experiment.comparison import compare
from jaxphoto.experiment.declaration import Experiment
from jaxphoto.experiment.page import experiment_page, index_page
from jaxphoto.experiment.runner import Run
from jaxphoto.report.page import Made
from jaxphoto.writing import whole_folder

FILE = "experiment.py"


def find_experiments(directory: Path, name: str) -> list[Path]:
    """The folders of the experiment `name`, or of `all`, in `directory`. Raises InputError where there is none."""
    known = sorted(path.parent for path in directory.glob(f"*/{FILE}"))
    if not known:
        raise InputError(
            f"{directory} holds no experiments (folders with {FILE}); go to the folder that has experiments/, name it "
            "with --experiments, or write those of the papers there first (jaxphoto example experiments)"
        )
    chosen = known if name == "all" else [path for path in known if path.name == name]
    if not chosen:
        names = ", ".join(path.name for path in known)
        raise InputError(f"there is no experiment {name} in {directory}; choose {names} or all")
    return chosen


def load_experiment(folder: Path) -> Experiment:
    """The EXPERIMENT that experiment.py in `folder` declares. Raises InputError where it does not."""
    path = folder / FILE
    spec = importlib.util.spec_from_file_location(f"jaxphoto_experiment_{folder.name}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError(f"there is no file {path}; an experiment is a folder with {FILE}")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{path} cannot be run ({type(error).__name__}: {error}); correct it") from error
    experiment = getattr(module, "EXPERIMENT", None)
    if not isinstance(experiment, Experiment):
        raise InputError(f"{path} declares no EXPERIMENT; end it with EXPERIMENT = Experiment(...)")
    return experiment


def write_runs(runs: Mapping[Path, Run], out: Path, made: Mapping[Path, Made] = MappingProxyType({})) -> None:
    """tables.csv, cells.csv (every layout) and report.html of the `runs` of some experiment folders, in `out`.

    Several experiments have a page each, to which report.html leads; a page says how its runs were `made`. Raises what
    `whole_folder` raises.
    """
    tables = {folder: compare(run, folder) for folder, run in runs.items()}
    only = len(runs) == 1
    pages = {
        "report.html" if only else f"{folder.name}.html": experiment_page(run, tables[folder], made.get(folder))
        for folder, run in runs.items()
    }
    if not only:
        pages["report.html"] = index_page({f.name: (run.experiment.title, tables[f]) for f, run in runs.items()})
    cells = [run.cells.assign(experiment=folder.name) for folder, run in runs.items()]
    with whole_folder(out) as work:
        pd.concat(tables.values(), ignore_index=True).to_csv(work / "tables.csv", index=False)
        pd.concat(cells, ignore_index=True).to_csv(work / "cells.csv", index=False)
        for name, page in pages.items():
            (work / name).write_text(page, encoding="utf-8")
