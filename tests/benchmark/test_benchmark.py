import pytest

from mambaloc import create_model
from mambaloc.benchmark import LoadingRates, measure_loading, published_accounting
from mambaloc.data import PoseDataModule


def test_loading_is_timed_both_ways(scenes):
    data = PoseDataModule("7scenes", str(scenes), "heads", image_size=32, short_side=36, batch_size=4)
    rates = measure_loading(data, batches=2, repetitions=3)
    assert len(rates.cached) == len(rates.decoded) == 3
    assert min(rates.cached + rates.decoded) > 0


def test_ratio_is_of_medians():
    assert LoadingRates(cached=[10.0, 30.0, 1000.0], decoded=[1.0, 3.0, 4.0]).ratio == 10


@pytest.mark.parametrize(("gis", "published"), [("gis", 11_073_131), ("none", 10_635_371)])
def test_published_accounting_is_the_papers(gis, published):
    items = published_accounting(create_model("mambaloc", gis=gis).network)
    assert items.pop("published") == published == sum(items.values())
    assert items["dead backbone"] == 4_436_740
