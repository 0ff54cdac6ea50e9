"""Images that wait for the same bundle are localized together."""

import asyncio
from collections import deque

import event_loop
import numpy as np
import pytest

from mambaloc.errors import InputError
from mambaloc.images import read_image
from mambaloc.runtime import Localizer
from mambaloc.serving.workers import Task, Workers, _Waiting, _Worker, next_batch


def waiting(*tasks: tuple[str, bool, int]) -> deque[_Waiting]:
    """Tasks that wait: bundle, whether distorted, and how many workers were lost with it."""
    return deque(_Waiting(Task(name, b"", None, distorted), None, lost) for name, distorted, lost in tasks)


DEN, DISTORTED, LOST, HALL = ("den", False, 0), ("den", True, 0), ("den", False, 1), ("hall", False, 0)
RAW = ("raw", False, 0)


@pytest.mark.parametrize(
    ("tasks", "sizes"),
    [
        ([DEN], [1]),
        ([DEN] * 9, [4, 4, 1]),
        ([DEN, HALL, DEN, DEN], [1, 1, 2]),
        ([DISTORTED, DISTORTED, DEN], [2, 1]),
        ([LOST, LOST, DEN, DEN, LOST, DEN], [1, 1, 2, 1, 1]),
        ([RAW, RAW, DEN], [1, 1, 1]),
    ],
)
def test_batches_hold_what_one_bundle_localizes_alike_and_pictures_that_cost_a_worker_go_alone(tasks, sizes):
    left = waiting(*tasks)
    batches = [next_batch(left, {"den", "hall"}) for _ in sizes]
    assert [len(batch) for batch in batches] == sizes
    assert not left


@pytest.fixture(scope="module")
def frames(bundle_of_tensors):
    return sorted((bundle_of_tensors / "frames").glob("*.png"))[:4]


@pytest.mark.parametrize("kind", ["bundle_of_tensors", "bundle_of_pictures"])
def test_a_batch_has_the_poses_of_its_images_alone(request, frames, kind):
    localizer = Localizer(request.getfixturevalue(kind), threads=1)
    images = [read_image(frames[0]), read_image(frames[1]), read_image(frames[2])[:-8, :-6]]
    together = list(localizer.localize_batch(images))
    assert len(together) == 3
    for image, found in zip(images, together, strict=True):
        alone = localizer.localize(image)
        np.testing.assert_allclose(found.position_m, alone.position_m, atol=1e-5)
        np.testing.assert_allclose(found.quaternion, alone.quaternion, atol=1e-5)
        assert (found.source, found.is_unfamiliar) == (alone.source, alone.is_unfamiliar)


@pytest.mark.parametrize(("kind", "runs_batches"), [("bundle_of_tensors", True), ("bundle_of_pictures", False)])
def test_a_model_of_raw_input_gains_nothing_by_batches(request, kind, runs_batches):
    assert Localizer(request.getfixturevalue(kind), threads=1).runs_batches is runs_batches


def test_a_batch_with_an_image_that_cannot_be_localized_has_no_poses(bundle_of_tensors, frames):
    localizer = Localizer(bundle_of_tensors, threads=1)
    with pytest.raises(InputError, match="uint8"):
        next(localizer.localize_batch([read_image(frames[0]), np.zeros((96, 128, 3))]))


def test_pictures_that_come_at_once_share_a_worker_and_a_bad_one_is_refused_alone(
    bundle_of_tensors, frames, monkeypatch
):
    sizes, ask = [], _Worker.ask
    monkeypatch.setattr(_Worker, "ask", lambda worker, tasks: sizes.append(len(tasks)) or ask(worker, tasks))
    pictures = [frame.read_bytes() for frame in frames] + [b"no image"] + [frames[0].read_bytes()] * 3

    async def localize():
        workers = Workers({"den": bundle_of_tensors}, 1)
        await workers.start()
        try:
            return await asyncio.gather(*(workers.localize(Task("den", each)) for each in pictures))
        finally:
            workers.stop()

    answers = event_loop.run(localize())
    assert sizes == [1, 4, 3]
    assert answers[4] == {"error": "image cannot be decoded"}
    alone = Localizer(bundle_of_tensors, threads=1)
    for picture, answer in zip([*frames, None, *[frames[0]] * 3], answers, strict=True):
        if picture is not None:
            np.testing.assert_allclose(answer["position_m"], alone.localize(picture).position_m, atol=1e-5)


def test_a_picture_whose_client_has_gone_is_not_localized(bundle_of_tensors, frames, monkeypatch):
    asked, ask = [], _Worker.ask
    monkeypatch.setattr(_Worker, "ask", lambda worker, tasks: asked.extend(tasks) or ask(worker, tasks))
    tasks = [Task("den", frame.read_bytes()) for frame in frames[:3]]

    async def localize():
        workers = Workers({"den": bundle_of_tensors}, 1)
        await workers.start()
        try:
            coming = [asyncio.create_task(workers.localize(task)) for task in tasks]
            await asyncio.sleep(0)
            coming[1].cancel()
            return await asyncio.gather(*coming, return_exceptions=True)
        finally:
            workers.stop()

    first, second, third = event_loop.run(localize())
    assert isinstance(second, asyncio.CancelledError)
    assert first["source"] == third["source"] == "network"
    assert asked == [tasks[0], tasks[2]]
