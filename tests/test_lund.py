"""29 real photographs of a walk along a street, oriented from their features alone; COLMAP's poses beside ours."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxphoto.extras.photos.features import FEATURES
from jaxphoto.extras.photos.matching import match_photographs, photograph_pairs
from jaxphoto.io.photographs import photographs, sensor_and_interior
from jaxphoto.procedures.orientation import orient
from jaxphoto.procedures.orientation.blocks import similarity_between

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(data_dir):
    images = data_dir / "lund" / "images"
    if not images.is_dir():
        pytest.skip(f"no photographs in {images}")
    return images


def oriented(folder, count=None):
    taken = photographs(sorted(folder.glob("*.jpg")))
    camera = sensor_and_interior(taken)
    matched = match_photographs(taken, camera.sensor, camera.interior, photograph_pairs(taken), count=count)
    names = [p.name for p in taken]
    return orient(names, camera.sensor, camera.interior, matched.xy_mm, matched.pairs, matched.sigma_mm)


def test_the_street_is_oriented(folder):
    found = oriented(folder)
    report = found.report
    assert report.n_images == 29
    assert len(report.order) >= 25
    assert report.mean_px <= 1
    assert report.settled and report.converged
    # EXIF says 1,035 pixels; a walk straight ahead tells little of it.
    c_px = float(found.block.start.unknowns.interior["camera"].c) / found.block.sensors["camera"].pixel_mm
    assert 600 < c_px < 1300


def colmap_model(folder, tmp_path, c_px):
    """COLMAP's poses for this principal distance: of three attempts, the one that places most images best."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, the independent check, is not installed")
    pycolmap.logging.minloglevel = 2
    database = tmp_path / "colmap.db"
    one = pycolmap.CameraMode.SINGLE
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", camera_params=f"{c_px},512,384,0")
    pycolmap.extract_features(database, folder, camera_mode=one, reader_options=reader, device=pycolmap.Device.cpu)
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    found = []
    for seed in range(3):
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed, ba_refine_focal_length=False)
        # As it comes, COLMAP finds no two images to begin with: all look along the line they stand on.
        options.mapper.init_max_forward_motion = 1.0
        options.mapper.init_min_tri_angle = 4.0
        options.triangulation.ignore_two_view_tracks = False
        (output := tmp_path / str(seed)).mkdir()
        found += pycolmap.incremental_mapping(database, folder, output, options).values()
    best = max(found, key=lambda m: (m.num_reg_images(), -m.compute_mean_reprojection_error()))
    return {i.name.removesuffix(".jpg"): i for i in best.images.values() if i.has_pose}


def test_poses_are_those_of_colmap(folder, tmp_path):
    """To a hundredth of the path's length, after a similarity: each of the images that both have oriented.

    With our principal distance, which a walk straight ahead hardly determines: COLMAP's own is 752 px with residuals of
    0.503 px, ours about 908 px, with which its residuals are 0.51 px. EXIF says 1,035 px.
    """
    found = oriented(folder, FEATURES)
    camera = found.block.sensors["camera"]
    theirs = colmap_model(folder, tmp_path, float(found.block.start.unknowns.interior["camera"].c) / camera.pixel_mm)
    ours = found.block.start.unknowns.exterior
    place = {name: k for k, name in enumerate(found.block.images)}
    both = sorted(set(place) & set(theirs))
    assert len(both) >= 20
    own = [place[name] for name in both]
    there, here = ours.position[own], np.array([theirs[name].projection_center() for name in both])
    s = similarity_between(there, here)
    off = np.linalg.norm(s.shift + s.scale * there @ s.turn.T - here, axis=1)
    path = np.linalg.norm(np.diff(here, axis=0), axis=1).sum()
    # COLMAP's camera looks along its third axis, its second points down.
    turned = [np.diag([1.0, -1, -1]) @ theirs[n].cam_from_world().rotation.matrix() @ s.turn for n in both]
    apart = Rotation.from_matrix(np.array(turned) @ np.asarray(ours.camera_from_object)[own].transpose(0, 2, 1))
    # Another principal point turns all images alike in their own frames.
    alike = apart.mean()
    angle = np.degrees((alike.inv() * apart).magnitude())
    print(
        f"{len(both)} images, {100 * off.mean() / path:.2f} % on average, {100 * off.max() / path:.2f} % at most; "
        f"turned by {np.degrees(alike.magnitude()):.2f} degrees together, {angle.max():.2f} at most besides"
    )
    assert off.max() < 0.01 * path
    assert np.median(angle) < 0.4 and angle.max() < 1.2
