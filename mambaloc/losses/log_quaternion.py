"""Losses on log-quaternions: AtLoc's on single images, and MapNet's, which adds the relative poses within clips."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mambaloc.errors import InputError
from mambaloc.geometry import log_from_quaternion
from mambaloc.losses.weighted import weighed
from mambaloc.types import PoseBatch, PosePrediction


class LogQuaternionWeights(nn.Module):
    """L1 distances of position and log-quaternion with learned weights (MapNet, Brahmbhatt et al. 2018, its h).

    ``|t - t^|_1 exp(-s_x) + s_x + |w - w^|_1 exp(-s_q) + s_q``. Unbounded below, as
    :class:`~mambaloc.losses.weighted.LearnedWeights` is.

    Args:
        s_position: initial log-scale of position.
        s_rotation: initial log-scale of rotation.
    """

    def __init__(self, s_position: float = 0.0, s_rotation: float = -3.0) -> None:
        super().__init__()
        self.s_position = nn.Parameter(torch.tensor(float(s_position)))
        self.s_rotation = nn.Parameter(torch.tensor(float(s_rotation)))

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters that an optimiser must not decay."""
        return {name for name, _ in self.named_parameters()}

    def forward(self, prediction: PosePrediction, target: PoseBatch) -> Tensor:
        """Weigh the two mean distances; a scalar."""
        return self._absolute(*_residuals(prediction, target))

    def _absolute(self, position_m: Tensor, log_quaternion: Tensor) -> Tensor:
        return weighed(_l1(position_m), self.s_position) + weighed(_l1(log_quaternion), self.s_rotation)


class RelativeLogQuaternionWeights(LogQuaternionWeights):
    """The same on each frame and, with weights of its own, on the pose of each frame of a clip relative to the next.

    A relative pose is the difference of positions and of log-quaternions, MapNet's equation 3. Single frames have
    none: evaluation adds nothing for them, training refuses them.

    Args:
        s_position: initial log-scale of position.
        s_rotation: initial log-scale of rotation.
        s_relative_position: initial log-scale of relative position.
        s_relative_rotation: initial log-scale of relative rotation.
    """

    def __init__(
        self,
        s_position: float = 0.0,
        s_rotation: float = -3.0,
        s_relative_position: float = 0.0,
        s_relative_rotation: float = -3.0,
    ) -> None:
        super().__init__(s_position, s_rotation)
        self.s_relative_position = nn.Parameter(torch.tensor(float(s_relative_position)))
        self.s_relative_rotation = nn.Parameter(torch.tensor(float(s_relative_rotation)))

    def forward(self, prediction: PosePrediction, target: PoseBatch) -> Tensor:
        """Weigh the mean distances; a scalar.

        Raises:
            InputError: for single frames while training.
        """
        residuals = _residuals(prediction, target)
        absolute = self._absolute(*residuals)
        if target.clip_length == 1:
            if self.training:
                raise InputError(
                    "loss relative_log_quaternion: needs clips of 2 consecutive frames or more, but "
                    "data gives single frames; set data.clip_length (3 in the paper) and data.clip_skip (10)"
                )
            return absolute
        # Differences are linear, so the residual of a relative pose is the difference of two residuals.
        position, rotation = (_l1(each.unflatten(0, (-1, target.clip_length)).diff(dim=1)) for each in residuals)
        relative = weighed(position, self.s_relative_position) + weighed(rotation, self.s_relative_rotation)
        return absolute + relative


def _residuals(prediction: PosePrediction, target: PoseBatch) -> tuple[Tensor, Tensor]:
    """What is missing to the true position, in metres, and log-quaternion; (B, 3) each."""
    if prediction.log_quaternion is None:
        raise InputError(
            "loss: needs a system that regresses log-quaternions (lstm_posenet, mapnet, atloc); "
            "this one regresses quaternions, so use learned_weights or fixed_weights"
        )
    return (
        prediction.position_m - target.position_m,
        prediction.log_quaternion - log_from_quaternion(target.quaternion),
    )


def _l1(residual: Tensor) -> Tensor:
    return residual.abs().sum(-1).mean()
