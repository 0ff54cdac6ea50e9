"""What a student learns from its teacher: the soft and feature terms of distillation (MambaLoc, section III-D)."""

from __future__ import annotations

from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mambaloc.geometry import canonical, normalize
from mambaloc.losses.weighted import weighed
from mambaloc.types import PosePrediction

Soft = Literal["kl", "l2"]


def softened_kl(student: Tensor, teacher: Tensor, temperature: float) -> Tensor:
    """``T^2 KL(softmax(teacher / T) || softmax(student / T))``, the mean over a batch of vectors (Hinton et al. 2015).

    A softmax sees differences of coordinates alone: a student that is off by the same amount on every axis has no
    loss, and what it has for the same relative error falls with the coordinates' scale.

    Shape:
        (B, D), (B, D) -> ().
    """
    log_student, log_teacher = ((x / temperature).log_softmax(dim=-1) for x in (student, teacher))
    return temperature**2 * F.kl_div(log_student, log_teacher, reduction="batchmean", log_target=True)


def cosine_distance(student: Tensor, teacher: Tensor) -> Tensor:
    """``1 - cos`` of a batch of features, its mean.

    Shape:
        (B, D), (B, D) -> ().
    """
    return (1 - F.cosine_similarity(student, teacher, dim=-1)).mean()


class SoftTargets(nn.Module):
    """Distance of the student's pose to the teacher's, position and rotation with learned weights.

    Args:
        soft: ``kl``, the paper's :func:`softened_kl`; or ``l2``, the distance itself, which has neither of its blind
            spots.
        temperature: of ``kl``.
        s_position: initial log-variance of position.
        s_rotation: initial log-variance of rotation.
    """

    def __init__(
        self, soft: Soft = "kl", temperature: float = 10.0, s_position: float = -0.5, s_rotation: float = -6.5
    ) -> None:
        super().__init__()
        if soft not in get_args(Soft):
            raise ValueError(f"soft is 'kl' or 'l2', not {soft!r}")
        if temperature <= 0:
            raise ValueError(f"temperature is positive, not {temperature}")
        self.soft, self.temperature = soft, float(temperature)
        self.s_position = nn.Parameter(torch.tensor(float(s_position)))
        self.s_rotation = nn.Parameter(torch.tensor(float(s_rotation)))

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters that an optimiser must not decay."""
        return {"s_position", "s_rotation"}

    def forward(self, student: PosePrediction, teacher: PosePrediction) -> Tensor:
        """Weigh the distances of two predictions of the same images; a scalar.

        Positions are compared as they are given: normalised ones, or the scene's size matters.
        """
        position = self._distance(student.position_m, teacher.position_m)
        rotation = self._distance(normalize(student.quaternion), canonical(teacher.quaternion))
        return weighed(position, self.s_position) + weighed(rotation, self.s_rotation)

    def _distance(self, student: Tensor, teacher: Tensor) -> Tensor:
        if self.soft == "l2":
            return torch.linalg.vector_norm(student - teacher, dim=-1).mean()
        return softened_kl(student, teacher, self.temperature)
