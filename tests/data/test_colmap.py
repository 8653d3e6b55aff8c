"""COLMAP models: pycolmap's own camera models and keypoints are the truth."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from dreamcatalyst.data import colmap
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.errors import ConfigError, DataError

WIDTH, HEIGHT = 64, 48
FOX = Path(__file__).parents[2] / "../shared/scenes/fox"
# pycolmap's parameters of a moderately distorted lens, principal point off the centre.
PARAMS = {
    "SIMPLE_PINHOLE": [50, 31, 25],
    "PINHOLE": [50, 54, 31, 25],
    "SIMPLE_RADIAL": [50, 31, 25, -0.1],
    "RADIAL": [50, 31, 25, 0.08, -0.02],
    "OPENCV": [50, 54, 31, 25, -0.1, 0.02, 0.003, -0.002],
    "FULL_OPENCV": [50, 54, 31, 25, 0.1, 0.02, 0.003, -0.002, 0.01, 0.05, 0.01, 0.002],
    "SIMPLE_FISHEYE": [40, 31, 25],
    "FISHEYE": [40, 43, 31, 25],
    "SIMPLE_RADIAL_FISHEYE": [40, 31, 25, 0.05],
    "RADIAL_FISHEYE": [40, 31, 25, 0.05, -0.01],
    "OPENCV_FISHEYE": [40, 43, 31, 25, 0.05, -0.01, 0.004, -0.001],
}
KNOWN = [name for name in PARAMS if name in pycolmap.CameraModelId.__members__]  # older pycolmaps have fewer


def write_model(
    root: Path, model="PINHOLE", names=("b.png", "a.png"), points=((0.1, 0.2, 3.0),), where="sparse/0", photos=None
) -> Path:
    """A text model of one camera, images that step along x, and photographs of the camera's size."""
    folder = root / where
    folder.mkdir(parents=True)
    params = " ".join(str(p) for p in PARAMS.get(model, PARAMS["PINHOLE"]))
    (folder / "cameras.txt").write_text(f"1 {model} {WIDTH} {HEIGHT} {params}\n")
    (folder / "images.txt").write_text("".join(f"{i + 1} 1 0 0 0 {i} 0 0 1 {n}\n\n" for i, n in enumerate(names)))
    rows = (f"{i + 1} {x} {y} {z} 255 128 0 0.5\n" for i, (x, y, z) in enumerate(points))
    (folder / "points3D.txt").write_text("".join(rows))
    for name in names if photos is None else photos:
        (root / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / "images" / name), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    return root


def to_binary(folder: Path) -> None:
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    for path in folder.glob("*.txt"):
        path.unlink()


@pytest.mark.parametrize("name", KNOWN)
def test_a_lens_projects_as_colmap_does(name):
    camera = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=PARAMS[name])
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    truth = camera.img_from_cam(np.concatenate([rays, np.ones((50, 1))], axis=1))
    np.testing.assert_allclose(colmap.lens(camera).project(rays), truth, atol=1e-6)


def test_every_camera_model_of_colmap_is_read_or_refused_by_name():
    create = getattr(pycolmap.Camera, "create_from_model_id", None) or pycolmap.Camera.create  # its name before 4.0
    for name in set(pycolmap.CameraModelId.__members__) - {"INVALID"} - set(colmap.MODELS):
        camera = create(1, pycolmap.CameraModelId.__members__[name], 50.0, WIDTH, HEIGHT)
        with pytest.raises(DataError, match=f"unknown camera model '{name}'.*Undistort"):
            colmap.lens(camera)


@pytest.mark.parametrize("name", KNOWN)
def test_a_point_is_where_its_blob_was_photographed(tmp_path, name):
    """A blob is painted into the distorted photograph where pycolmap sees the point; it must be found, in the
    undistorted, shrunk and cropped image, where the view's camera projects the point."""
    write_model(tmp_path, name, names=["a.png"])
    scale = 10  # a photograph larger than its camera: intrinsics are scaled to the file
    camera = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=PARAMS[name])
    point = np.array([0.28, -0.25, 1.2])
    camera.rescale(WIDTH * scale, HEIGHT * scale)
    x, y = camera.img_from_cam(point[None])[0]
    cols, rows = np.meshgrid(np.arange(WIDTH * scale) + 0.5, np.arange(HEIGHT * scale) + 0.5)
    blob = 255 * np.exp(-((cols - x) ** 2 + (rows - y) ** 2) / (2 * 6**2))
    cv2.imwrite(str(tmp_path / "images" / "a.png"), blob.round().astype(np.uint8))

    view = open_capture(tmp_path, CaptureOptions(width=200, height=200, test_every=0))
    image = view.image(0)[..., 0].double()
    image = image * (image > 0.1)
    rows, cols = torch.meshgrid(torch.arange(200) + 0.5, torch.arange(200) + 0.5, indexing="ij")
    seen = torch.stack([(image * cols).sum(), (image * rows).sum()]) / image.sum()
    projected = view.cameras().Ks[0] @ torch.from_numpy(point).float()
    torch.testing.assert_close(seen.float(), projected[:2] / projected[2], atol=0.06, rtol=0)


@pytest.mark.parametrize("name", KNOWN)
def test_undistorted_photographs_have_no_empty_corner(name):
    lens = colmap.lens(pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=PARAMS[name]))
    flat = lens.pinhole()
    assert not flat.distorted
    corners = np.array([[0, 0], [WIDTH, 0], [0, HEIGHT], [WIDTH, HEIGHT]], float)
    pixels = lens.project((corners - (flat.cx, flat.cy)) / (flat.fx, flat.fy))
    assert (pixels >= -1e-6).all() and (pixels <= (WIDTH + 1e-6, HEIGHT + 1e-6)).all()


@pytest.mark.parametrize("where", ["sparse/0", "sparse"])
@pytest.mark.parametrize("binary", [False, True])
def test_text_and_binary_in_both_places(tmp_path, where, binary):
    write_model(tmp_path, where=where)
    if binary:
        to_binary(tmp_path / where)
    capture = open_capture(tmp_path, CaptureOptions(test_every=0))
    assert [view.name for view in capture.views] == ["a.png", "b.png"]
    torch.testing.assert_close(capture.cameras().centers, torch.tensor([[-1.0, 0, 0], [0, 0, 0]]))
    torch.testing.assert_close(capture.points.xyz, torch.tensor([[0.1, 0.2, 3.0]]))
    torch.testing.assert_close(capture.points.rgb, torch.tensor([[255.0, 128, 0]]) / 255)
    assert capture.notices == ()


def test_a_smaller_copy_of_the_photographs_scales_the_camera(tmp_path):
    write_model(tmp_path, names=["a.png"])
    (tmp_path / "images_2").mkdir()
    cv2.imwrite(str(tmp_path / "images_2/a.png"), np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))
    camera = open_capture(tmp_path, CaptureOptions(images="images_2", test_every=0)).views[0].camera
    torch.testing.assert_close(camera.Ks[0], torch.tensor([[25, 0, 15.5], [0, 27, 12.5], [0, 0, 1]]))
    assert (camera.width, camera.height) == (WIDTH // 2, HEIGHT // 2)


def test_photographs_that_are_not_registered_are_counted(tmp_path):
    write_model(tmp_path, photos=["a.png", "b.png", "c.png", "more/d.png"])
    (notice,) = open_capture(tmp_path).notices
    assert "2 of 4 photographs are not registered" in notice and "c.png" in notice


def test_other_models_and_missing_points_are_noticed(tmp_path):
    write_model(tmp_path, points=())
    (tmp_path / "sparse/1").mkdir()
    capture = open_capture(tmp_path)
    assert capture.points is None
    assert any("more models (1)" in n for n in capture.notices) and any("no points" in n for n in capture.notices)


def test_missing_photographs(tmp_path):
    write_model(tmp_path, photos=["a.png"])
    with pytest.raises(DataError, match="1 of 2 photographs are missing.*b.png"):
        open_capture(tmp_path)


def test_missing_folder_of_photographs(tmp_path):
    write_model(tmp_path, photos=())
    with pytest.raises(DataError, match="no folder 'images'.*data.images"):
        open_capture(tmp_path)


def test_an_empty_reconstruction(tmp_path):
    write_model(tmp_path, names=(), photos=["a.png"])
    with pytest.raises(DataError, match="empty reconstruction"):
        open_capture(tmp_path)


def test_no_model_and_half_a_model(tmp_path):
    (tmp_path / "sparse").mkdir()
    with pytest.raises(DataError, match="no sparse model"):
        open_capture(tmp_path)
    (tmp_path / "sparse/cameras.txt").write_text("")
    with pytest.raises(DataError, match="incomplete, images.txt, points3D.txt is missing"):
        open_capture(tmp_path)


def test_an_unknown_camera_model(tmp_path):
    write_model(tmp_path)
    (tmp_path / "sparse/0/cameras.txt").write_text(f"1 FOV {WIDTH} {HEIGHT} 50 50 32 24 0.1\n")
    with pytest.raises(DataError, match="unknown camera model 'FOV'"):
        open_capture(tmp_path)


@pytest.mark.parametrize("size, remark", [((HEIGHT, WIDTH + 9), ""), ((WIDTH, HEIGHT), ". It lies on its side")])
def test_photographs_of_another_shape(tmp_path, size, remark):
    write_model(tmp_path, names=["a.png"])
    cv2.imwrite(str(tmp_path / "images/a.png"), np.zeros((*size, 3), np.uint8))
    with pytest.raises(DataError, match=f"a.png.*not the shape of its camera, 64x48{remark}"):
        open_capture(tmp_path)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("keep", [0.0, 0.5, 0.99])
def test_truncated_binary_models(tmp_path, part, keep):
    write_model(tmp_path, points=[(x, 0, 2) for x in range(5)])
    folder = tmp_path / "sparse/0"
    to_binary(folder)
    whole = (folder / f"{part}.bin").read_bytes()
    (folder / f"{part}.bin").write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(DataError, match="damaged"):
        open_capture(tmp_path)


def test_a_text_model_that_is_damaged(tmp_path):
    write_model(tmp_path)
    (tmp_path / "sparse/0/cameras.txt").write_text("1 PINHOLE 64 48 50\n")
    with pytest.raises(DataError, match="cannot be read"):
        open_capture(tmp_path)


def test_formats_by_name(tmp_path):
    write_model(tmp_path)
    assert len(open_capture(tmp_path, CaptureOptions(format="colmap"))) == 2
    with pytest.raises(ConfigError, match="Did you mean 'colmap'"):
        open_capture(tmp_path, CaptureOptions(format="colmpa"))
    shutil.rmtree(tmp_path / "sparse")
    for photograph in (tmp_path / "images").iterdir():
        photograph.unlink()
    with pytest.raises(
        DataError, match=r"is no capture. Looked for colmap: .*nerfstudio: transforms.json.*Found images"
    ):
        open_capture(tmp_path)


@pytest.mark.skipif(not FOX.is_dir(), reason="the fox capture is not here")
def test_the_fox_has_the_reprojection_errors_that_colmap_wrote_down():
    capture = open_capture(FOX, CaptureOptions(width=300, height=400))
    assert (len(capture), len(capture.test), capture.notices) == (50, 7, ())
    model = pycolmap.Reconstruction(str(FOX / "sparse/0"))
    errors = {number: [] for number in model.points3D}
    for view in capture.views:
        seen = [p for p in model.find_image_with_name(view.name).points2D if p.has_point3D()]
        points = torch.from_numpy(np.array([model.points3D[p.point3D_id].xyz for p in seen]))
        viewmat, K = view.camera.viewmats[0].double(), view.camera.Ks[0].double()
        x = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
        left, top, width, height = view.photo.window
        pixels = (x[:, :2] / x[:, 2:]).numpy() * (width / 300, height / 400) + (left, top)
        for p, distance in zip(seen, np.linalg.norm(pixels - [p.xy for p in seen], axis=1), strict=True):
            errors[p.point3D_id].append(distance)
    ours = [np.mean(errors[number]) for number in model.points3D]
    np.testing.assert_allclose(ours, [p.error for p in model.points3D.values()], atol=0.01)  # pixels
    assert np.mean(ours) == pytest.approx(model.compute_mean_reprojection_error(), abs=1e-3)


@pytest.mark.skipif(not FOX.is_dir(), reason="the fox capture is not here")
def test_the_fox_at_a_quarter():
    capture = open_capture(FOX, CaptureOptions(downscale=4))
    assert capture.image(0).shape == (239, 134, 3)
    assert len(capture.points.xyz) == 10814
