"""What a loaded system takes is what it was measured on."""

import cv2
import numpy as np
import pytest
import torch

import mambaloc
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError


@pytest.mark.parametrize("name", ["denseloc.embedded_room", "student.embedded_room"])
def test_pictures_come_as_test_frames_do(name):
    system = mambaloc.load(name)
    data = PoseDataModule("embedded", image_size=system.image_size, short_side=78)
    data.setup("test")
    batch = next(iter(data.batches("test")))
    transform = mambaloc.create_transform(system)
    paths = data.frames("test").image_paths[:3]
    images = torch.stack([transform(path) for path in paths])
    torch.testing.assert_close(images, batch.image[:3].float() / (255 if batch.image.dtype == torch.uint8 else 1))
    with torch.inference_mode():
        torch.testing.assert_close(system(images).position_m, system(batch.image[:3]).position_m)


def test_arrays_and_files_are_alike(tmp_path):
    transform = mambaloc.create_transform(mambaloc.load("student.embedded_room"))
    pixels = np.random.default_rng(0).integers(256, size=(120, 200, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), pixels[..., ::-1])
    assert transform(pixels).shape == (3, 72, 96)
    torch.testing.assert_close(transform(tmp_path / "a.png"), transform(pixels), rtol=0, atol=0)


def test_an_untrained_system_has_no_transform():
    with pytest.raises(InputError, match="student: has no record of its training images"):
        mambaloc.create_transform(mambaloc.create_model("student", backbone_weights=None))


def test_the_package_lists_its_names():
    assert {"create_model", "create_transform", "list_released", "load"} <= set(dir(mambaloc))
    assert all(hasattr(mambaloc, name) for name in dir(mambaloc))
