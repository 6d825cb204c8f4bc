"""Posterior samples compared with the Gaussian approximation: table and plots."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from jaxphoto.report.plots import label, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from jaxphoto.sensitivity.posterior import Posterior

_ANGLES = ("omega", "phi", "kappa")
_PANEL, _ACROSS = 2.6, 4
_NORMAL_97_5 = 1.959964


def posterior_table(posterior: Posterior) -> pd.DataFrame:
    """Least squares and posterior of each parameter; both a priori.

    Columns: parameter, optimum, laplace_sigma, laplace_2.5_percent, laplace_97.5_percent, posterior_mean,
    posterior_sigma, posterior_2.5_percent, posterior_97.5_percent, skewness, rhat, ess. Units are in the parameters'
    names, angles in degrees.
    """
    names, factor = _names(posterior)
    optimum, sigma = posterior.optimum * factor, np.sqrt(np.diagonal(posterior.laplace)) * factor
    low, high = np.quantile(posterior.draws, [0.025, 0.975], axis=0) * factor
    return pd.DataFrame(
        {
            "parameter": names,
            "optimum": optimum,
            "laplace_sigma": sigma,
            "laplace_2.5_percent": optimum - _NORMAL_97_5 * sigma,
            "laplace_97.5_percent": optimum + _NORMAL_97_5 * sigma,
            "posterior_mean": posterior.mean * factor,
            "posterior_sigma": np.sqrt(np.diagonal(posterior.covariance)) * factor,
            "posterior_2.5_percent": low,
            "posterior_97.5_percent": high,
            "skewness": posterior.skewness,
            "rhat": posterior.rhat,
            "ess": posterior.ess,
        }
    )


def posterior_figure(posterior: Posterior) -> Figure:
    """The sample of each parameter with its Gaussian, and the pair that deviates most from its 95 % ellipse."""
    names, factor = _names(posterior)
    k = len(names)
    panels = k + (k > 1)
    down = -(-panels // _ACROSS)
    figure = new_figure(_PANEL * min(panels, _ACROSS), _PANEL * down)
    places = [figure.add_subplot(down, min(panels, _ACROSS), 1 + n) for n in range(panels)]
    draws, optimum = posterior.draws * factor, posterior.optimum * factor
    laplace = posterior.laplace * np.outer(factor, factor)
    for j, axes in enumerate(places[:k]):
        _marginal(axes, draws[:, j], optimum[j], np.sqrt(laplace[j, j]))
        axes.set_xlabel(label(names[j]), fontsize=8)
    if k > 1:
        pair = list(np.unravel_index(np.argmax(posterior.outside), posterior.outside.shape))
        _pair(places[k], draws[:, pair], optimum[pair], laplace[np.ix_(pair, pair)])
        places[k].set_xlabel(label(names[pair[0]]), fontsize=8)
        places[k].set_ylabel(label(names[pair[1]]), fontsize=8)
        places[k].set_title(f"{100 * posterior.outside[tuple(pair)]:.0f} % outside, not 5 %", fontsize=8)
    for axes in places:
        axes.tick_params(labelsize=7)
        axes.locator_params(axis="x", nbins=4)
    places[0].legend(fontsize=7)
    return figure


def _names(posterior: Posterior) -> tuple[list[str], np.ndarray]:
    """Names with units, and factors to these units."""
    names, factor = [], np.ones(len(posterior.parameters))
    for j, parameter in enumerate(posterior.parameters):
        last = parameter.rsplit(".", 1)[-1]
        if last in _ANGLES:
            factor[j] = np.rad2deg(1.0)
        names.append(parameter + ("_deg" if last in _ANGLES else "_m" if last in ("X", "Y", "Z") else ""))
    return names, factor


def _marginal(axes: Axes, sample: np.ndarray, optimum: float, sigma: float) -> None:
    axes.hist(sample, bins=40, density=True, color="tab:blue", alpha=0.5, label="posterior")
    x = np.linspace(min(sample.min(), optimum - 3 * sigma), max(sample.max(), optimum + 3 * sigma), 200)
    density = np.exp(-0.5 * ((x - optimum) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    axes.plot(x, density, color="tab:red", lw=1.2, label="Laplace")
    axes.set_yticks([])


def _pair(axes: Axes, sample: np.ndarray, optimum: np.ndarray, covariance: np.ndarray) -> None:
    axes.plot(*sample.T, ".", ms=1.5, color="tab:blue", alpha=0.4)
    turn = np.linspace(0, 2 * np.pi, 200)
    circle = np.sqrt(-2 * np.log(0.05)) * np.stack([np.cos(turn), np.sin(turn)])
    axes.plot(*(optimum[:, None] + np.linalg.cholesky(covariance) @ circle), color="tab:red", lw=1.2)
