"""Metrics at known values, and the files that reports write."""

import math

import cv2
import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from dreamcatalyst.report.curve import Curve
from dreamcatalyst.report.metrics import METRICS, Metric
from dreamcatalyst.report.pictures import picture_row, write_png, write_video


@pytest.mark.parametrize("name", METRICS.names())
def test_a_metric_of_equal_images_has_its_known_value(name):
    image = torch.rand(2, 8, 8, 3, generator=torch.Generator().manual_seed(0))
    metric = METRICS.get(name)
    assert isinstance(metric, Metric)
    assert metric(image, image).tolist() == pytest.approx([metric.identity] * 2)
    worse = metric(image, (image + 0.2).clamp(0, 1))
    assert (worse < metric.identity).all() == (metric.better == "higher")


def test_psnr_of_a_known_error():
    a = torch.zeros(1, 4, 4, 3)
    assert METRICS.get("psnr")(a, a + 0.1).item() == pytest.approx(20.0, abs=1e-4)


def test_a_weight_leaves_the_other_pixels_out():
    a, b = torch.zeros(1, 2, 2, 3), torch.zeros(1, 2, 2, 3)
    b[:, 0] = 0.5
    inside = torch.tensor([[1.0, 1.0], [0.0, 0.0]])[None, :, :, None]
    assert METRICS.get("l1")(a, b, inside).item() == pytest.approx(0.5)
    assert METRICS.get("l1")(a, b, 1 - inside).item() == 0
    assert math.isnan(METRICS.get("l1")(a, b, 0 * inside).item())


def test_pictures_are_written_as_they_are(tmp_path):
    image = torch.zeros(6, 10, 3)
    image[..., 0] = 1.0
    row = picture_row([("a", image), ("b", image)])
    read = cv2.imread(str(write_png(tmp_path / "deep" / "row.png", row)))[..., ::-1]
    assert np.array_equal(read, row) and read.shape[1] == 20 and read[-1, 0].tolist() == [255, 0, 0]


def test_video_is_h264_that_browsers_play(tmp_path):
    frames = [np.full((33, 47, 3), 10 * i, np.uint8) for i in range(5)]
    path = write_video(tmp_path / "video.mp4", frames, fps=5)
    with imageio.get_reader(path) as reader:
        meta = reader.get_meta_data()
        assert meta["codec"] == "h264" and "yuv420p" in meta["pix_fmt"] and meta["size"] == (46, 32)
        assert sum(1 for _ in reader) == 5


@pytest.mark.parametrize("height, width", [(1, 1), (19, 1), (1, 6)])
def test_a_video_of_one_pixel_a_side_is_written(tmp_path, height, width):
    path = write_video(tmp_path / "video.mp4", [np.full((height, width, 3), 200, np.uint8)] * 3)
    with imageio.get_reader(path) as reader:
        assert abs(int(reader.get_data(0).mean()) - 200) < 8


def test_curve(tmp_path):
    curve = Curve()
    curve.add(step=0, seconds=0.0, psnr=1.0)
    curve.add(step=1, seconds=1.0, psnr=2.0, t=7)
    curve.add(step=1, seconds=1.0, psnr=3.0, t=7)
    curve.write_csv(tmp_path / "error.csv")
    assert (tmp_path / "error.csv").read_text().split() == ["step,seconds,psnr,t", "0,0.0,1.0,", "1,1.0,3.0,7"]
