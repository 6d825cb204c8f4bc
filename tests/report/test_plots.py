"""Figures draw what the tables hold."""

import dataclasses

import matplotlib.quiver
import numpy as np
import pytest

import jaxphoto
from jaxphoto.block import Rows
from jaxphoto.report import check_points_figure
from tests.blocks import aerial_block


def test_fails():
    pass
