"""Camera and rotations against closed forms, OpenCV and SciPy."""

import tracemalloc

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from mushpipe import Camera, quaternion_from_axis
from mushpipe.core.geometry import axis_from_quaternion, brown, brown_inverse

LENS = (0.12, -0.25, 0.001, -0.002, 0.09)
SIZE = (640, 480, 617.0, 612.0, 322.5, 238.25)
PINHOLE = Camera(*SIZE)
BROWN = Camera(*SIZE, "brown_conrady", LENS)
INVERSE = Camera(*SIZE, "inverse_brown_conrady", LENS)
MATRIX = np.array([[617.0, 0, 322.5], [0, 612.0, 238.25], [0, 0, 1]])
RATIONAL = Camera(*SIZE, "rational", (*LENS, 0.2, -0.1, 0.05))
CAMERAS = {camera.model: camera for camera in (PINHOLE, BROWN, INVERSE, RATIONAL)}
# Image and lens in the range of what librealsense reports: the SR300's depth is distorted most.
D405 = (848, 480, 432.6, 432.1, 421.3, 238.9)
D435 = (1280, 720, 912.4, 911.0, 643.7, 361.2)
LENSES = [
    (D405, (-0.0556, 0.0584, 0.0004, 0.0003, -0.0190)),
    (D435, (0.1610, -0.4913, 0.0006, -0.0012, 0.4418)),
    (SIZE, (0.1394, 0.0945, 0.0046, 0.0014, -0.0353)),
    (SIZE, (*LENS, 0.2, -0.1, 0.05)),
]

inside = st.tuples(st.floats(0, 639), st.floats(0, 479))


def points(n: int = 200) -> np.ndarray:
    rng = np.random.default_rng(1)
    z = rng.uniform(0.2, 2, n)
    return np.stack([rng.uniform(-0.45, 0.45, n) * z, rng.uniform(-0.35, 0.35, n) * z, z], axis=1)


def test_a_pinhole_by_hand():
    np.testing.assert_allclose(PINHOLE.project([[0.1, -0.2, 0.5]]), [[445.9, -6.55]])
    np.testing.assert_allclose(PINHOLE.deproject([[322.5, 238.25]], [0.7]), [[0, 0, 0.7]])
    np.testing.assert_allclose(PINHOLE.deproject([[939.5, 238.25]], [2.0]), [[2, 0, 2]])


@pytest.mark.parametrize(
    ("camera", "coefficients"),
    [(PINHOLE, None), (BROWN, np.array(LENS)), (RATIONAL, np.array(RATIONAL.coefficients))],
)
def test_projection_agrees_with_opencv(camera, coefficients):
    expected, _ = cv2.projectPoints(points(), np.zeros(3), np.zeros(3), MATRIX, coefficients)
    np.testing.assert_allclose(camera.project(points()), expected[:, 0], atol=1e-9)


def undistorted(pixels: np.ndarray, matrix: np.ndarray, lens: tuple[float, ...]) -> np.ndarray:
    """Rays (N, 2) at z = 1, by OpenCV."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 1000, 1e-15)
    return cv2.undistortPointsIter(
        pixels[:, None], matrix, np.array(lens), np.eye(3), np.eye(3), criteria
    )[:, 0]


@pytest.mark.parametrize(("size", "lens"), LENSES)
def test_deprojection_agrees_with_opencv(size, lens):
    """On every 20th pixel of the image, corners included, a millionth of a pixel."""
    fx, fy, cx, cy = size[2:]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(0.0, size[0], 20), np.arange(0.0, size[1], 20))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    depth = np.random.default_rng(0).uniform(0.2, 1, len(pixels))
    camera = Camera(*size, "rational" if len(lens) == 8 else "brown_conrady", lens)
    rays = undistorted(pixels, matrix, lens)
    expected = np.c_[rays, np.ones(len(rays))] * depth[:, None]
    np.testing.assert_allclose(camera.deproject(pixels, depth), expected, atol=1e-6 / fx)


@pytest.mark.parametrize(("size", "lens"), LENSES[:3])
def test_the_inverse_model_projects_as_opencv_undistorts(size, lens):
    rays = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 2))
    camera = Camera(*size, "inverse_brown_conrady", lens)
    expected = undistorted(rays, np.eye(3), lens) * size[2:4] + size[4:]
    found = camera.project(np.c_[rays, np.ones(len(rays))])
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_inverse_model_is_the_forward_polynomial_on_the_way_out():
    pixels = PINHOLE.project(points())
    rays = (pixels - SIZE[4:]) / SIZE[2:4]
    expected, _ = cv2.projectPoints(
        np.c_[rays, np.ones(len(rays))], np.zeros(3), np.zeros(3), np.eye(3), np.array(LENS)
    )
    found = INVERSE.deproject(pixels, np.ones(len(pixels)))
    np.testing.assert_allclose(found[:, :2], expected[:, 0], atol=1e-12)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@given(pixel=inside, depth=st.floats(0.1, 10))
def test_there_and_back_again(camera, pixel, depth):
    point = camera.deproject(np.array(pixel), np.array(depth))
    assert point[2] == depth
    np.testing.assert_allclose(camera.project(point), pixel, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_shapes_are_kept(camera):
    grid = camera.deproject(np.full((4, 5, 2), 300.0), np.full((4, 5), 0.5))
    assert grid.shape == (4, 5, 3)
    assert camera.project(grid).shape == (4, 5, 2)
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)
    assert camera.deproject(np.zeros((0, 2)), np.zeros(0)).shape == (0, 3)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_what_is_behind_the_camera_or_unknown_is_nan(camera):
    behind = np.array([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [np.nan, 0, 1], [0, 0, 1]])
    assert np.isnan(camera.project(behind)).any(axis=1).tolist() == [True, True, True, False]
    lifted = camera.deproject(np.array([[300.0, 200.0]]), np.array([np.nan]))
    assert np.isnan(lifted).all()


def test_a_ray_that_the_lens_cannot_have_is_nan():
    # With k1 = -1 the radius r (1 - r^2) is nowhere above 2 / (3 sqrt 3) = 0.3849.
    lens = (-1.0, 0.0, 0.0, 0.0, 0.0)
    found = brown_inverse(np.array([[0.38, 0.0], [0.39, 0.0]]), lens)
    radius = found[0, 0]
    assert radius == pytest.approx(min(r.real for r in np.roots([-1, 0, 1, -0.38]) if r.real > 0))
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize("camera", [BROWN, RATIONAL], ids=lambda camera: camera.model)
def test_the_rays_of_a_whole_image_take_little_memory_and_lead_back_to_its_pixels(camera):
    """Twelve megapixels once took 3 GB."""
    pixels = np.stack(np.mgrid[:640, :480], axis=-1).astype(float)
    tracemalloc.start()
    rays = camera.deproject(pixels, np.ones((640, 480)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6 * pixels.nbytes
    back, _ = cv2.projectPoints(
        rays.reshape(-1, 3), np.zeros(3), np.zeros(3), MATRIX, np.array(camera.coefficients)
    )
    np.testing.assert_allclose(back.reshape(pixels.shape), pixels, atol=1e-6)


def test_the_polynomial_by_hand():
    # x = 0.5, y = 0: r2 = 0.25
    expected = 0.5 * (1 + 0.1 * 0.25 + 0.2 * 0.0625 + 0.5 * 0.015625) + 0.04 * 3 * 0.25
    found = brown(np.array([0.5, 0.0]), (0.1, 0.2, 0.03, 0.04, 0.5))
    np.testing.assert_allclose(found, [expected, 0.03 * 0.25], rtol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 480, 1, 1, 0, 0), "size and focal length of a camera must be positive: Camera"),
        ((640, 480, 0, 1, 0, 0), "size and focal length of a camera must be positive: Camera"),
        (
            (640, 480, np.nan, 1, 0, 0),
            "size and focal length of a camera must be positive: Camera",
        ),
        ((*SIZE, "brown_conrady"), "camera model 'brown_conrady' with 0 coefficients; expected"),
        ((*SIZE, "none", LENS), "camera model 'none' with 5 coefficients; expected none, ("),
        ((*SIZE, "fisheye", LENS), "camera model 'fisheye' with 5 coefficients; expected none"),
    ],
)
def test_a_camera_that_cannot_be(arguments, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the message is compared
        Camera(*arguments)
    assert str(caught.value).startswith(message)


@given(arrays(np.float64, (7, 3), elements=st.floats(-1, 1)))
def test_quaternions_take_z_to_the_axis_without_spin(vectors):
    length = np.linalg.norm(vectors, axis=1)
    axis = vectors[length > 1e-3] / length[length > 1e-3, None]
    quaternion = quaternion_from_axis(axis)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1, atol=1e-12)
    for q, a in zip(quaternion, axis, strict=True):
        rotation = Rotation.from_quat(q)
        # An axis within 1e-6 of -z is taken for -z itself.
        np.testing.assert_allclose(rotation.apply([0, 0, 1]), a, atol=3e-6)
        # The shortest rotation turns by the angle between the axes.
        angle = np.arctan2(np.hypot(a[0], a[1]), a[2])
        assert rotation.magnitude() == pytest.approx(angle, abs=3e-6)
    assert (quaternion[:, 2:] >= [0, 0]).all()
    assert (quaternion[:, 2] == 0).all()


@given(arrays(np.float64, (7, 4), elements=st.floats(-1, 1)))
def test_axes_are_where_quaternions_turn_z_to(numbers):
    length = np.linalg.norm(numbers, axis=1)
    quaternion = numbers[length > 1e-3] / length[length > 1e-3, None]
    wanted = [Rotation.from_quat(q).apply([0, 0, 1]) for q in quaternion]
    found = axis_from_quaternion(quaternion)
    np.testing.assert_allclose(found, np.reshape(wanted, (-1, 3)), atol=1e-12)


@pytest.mark.parametrize(
    ("axis", "quaternion"),
    [
        ([0, 0, 1], [0, 0, 0, 1]),
        ([0, 0, -1], [1, 0, 0, 0]),
        ([1, 0, 0], [0, np.sqrt(0.5), 0, np.sqrt(0.5)]),
        ([0, 1, 0], [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)]),
        ([0, 0, -0.9999999], [1, 0, 0, 0]),  # of a normal in single precision
        ([np.nan] * 3, [np.nan] * 4),
    ],
)
def test_quaternions_by_hand(axis, quaternion):
    found = quaternion_from_axis(np.array([axis], float))
    np.testing.assert_allclose(found, [quaternion], atol=1e-15)


@pytest.mark.parametrize(
    "lens",
    [
        (-0.35, 0, 0, 0, 0),
        (-0.28, 0.07, 0.0002, 0, -0.01),
        (-0.5, 0.1, 0, 0, 0, -0.1, 0, 0),
    ],
)
@pytest.mark.parametrize("focal", [200.0, 300.0, 450.0])
def test_no_ray_lies_on_the_other_side_of_the_axis(lens: tuple[float, ...], focal: float) -> None:
    model = "brown_conrady" if len(lens) == 5 else "rational"
    camera = Camera(640, 480, focal, focal, 319.5, 239.5, model, lens)
    v, u = np.mgrid[:480:5, :640:5]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    ray = camera.deproject(pixels, np.ones(len(pixels)))[:, :2]
    aside = pixels - (319.5, 239.5)
    known = np.isfinite(ray).all(axis=1)
    assert known.any()
    assert not known.all() or focal == 450  # these lenses end within the image
    assert ((ray * aside).sum(axis=1)[known] >= -1e-3).all()
    # farther out on the image is farther out on the ray, as far as the model goes
    order = np.argsort(np.hypot(*aside[known].T))
    reach = np.maximum.accumulate(np.hypot(*ray[known][order].T))
    assert (reach - np.hypot(*ray[known][order].T)).max() < 0.05


def test_a_point_beyond_the_fold_of_a_lens_is_not_in_the_image():
    """Its polynomial turns round there, and would put the point where another one is seen."""
    lens = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, "brown_conrady", (-0.3, 0, 0, 0, 0))
    fold = (1 / 0.9) ** 0.5  # d/dr of r - 0.3 r^3 is 0
    inside, beyond = lens.project(np.array([[0.99 * fold, 0, 1], [1.01 * fold, 0, 1.0]]))
    assert inside[0] == pytest.approx(319.5 + 400 * 0.99 * fold * (1 - 0.3 * (0.99 * fold) ** 2))
    assert np.isnan(beyond).all()


def test_the_two_readings_of_a_d455s_lens_part_by_what_the_docs_say() -> None:
    """As OpenCV has them: into the image by `undistortPoints`, out of it by `projectPoints`."""
    lens = (-0.0565362684, 0.0682018697, 0.0003659752, 0.0006925757, -0.0218431670)
    width, height, fx, fy, cx, cy = 640, 480, 385.0, 384.4, 321.7, 238.9
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    pixels = np.array(
        [[x, y] for y in range(0, height, 60) for x in range(0, width + 1, 80)], float
    )
    into = cv2.undistortPoints(pixels, matrix, np.array(lens))[:, 0]
    flat = np.column_stack([(pixels - (cx, cy)) / (fx, fy), np.ones(len(pixels))])
    out_of = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), np.eye(3), np.array(lens))[0][:, 0]
    apart = 1000 * np.hypot(*(into - out_of).T)
    assert apart.max() == pytest.approx(27, abs=0.5)
    half_way = apart[(pixels == (160, 240)).all(axis=1) | (pixels == (480, 240)).all(axis=1)]
    assert half_way == pytest.approx([7, 7], abs=1.5)
    for model, rays in (("brown_conrady", into), ("inverse_brown_conrady", out_of)):
        camera = Camera(width, height, fx, fy, cx, cy, model, lens)
        found = camera.deproject(pixels, np.ones(len(pixels)))[:, :2]
        assert found == pytest.approx(rays, abs=2e-5)


def test_a_pixel_beyond_the_fold_of_an_inverse_lens_has_no_ray():
    """Its polynomial gives it that of a pixel within, hundreds of pixels away."""
    lens = Camera(640, 480, 400, 400, 319.5, 239.5, "inverse_brown_conrady", (-0.6, 0, 0, 0, 0))
    fold = (1 / 1.8) ** 0.5  # d/dr of r - 0.6 r^3 is 0
    pixels = np.array([[319.5 + 400 * share * fold, 239.5] for share in (0.99, 1.01)])
    within, beyond = lens.deproject(pixels, np.ones(2))
    np.testing.assert_allclose(lens.project(within), pixels[0], atol=1e-6)
    assert np.isnan(beyond[:2]).all()
