"""The README's Python runs."""

import re
from pathlib import Path

import torch

README = Path(__file__).parents[1] / "README.md"


def test_gis_goes_into_anyones_model():
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    (example,) = [block for block in blocks if "GlobalInformationSelector" in block]
    names: dict[str, object] = {}
    exec(example, names)
    model = names["model"]
    logits = model(torch.rand(2, 3, 64, 64))
    assert logits.shape == (2, 10)
    logits.sum().backward()
    selector = next(m for m in model.modules() if isinstance(m, names["GlobalInformationSelector"]))
    assert all(p.grad is not None for p in selector.parameters())
