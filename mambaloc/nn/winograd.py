"""3x3 convolutions with a quarter of the multiplications, for training on a CPU (Lavin and Gray 2016)."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

_TILE = 4  # output pixels along an axis of a tile
_WINDOW = _TILE + 2  # input pixels that they read
_WORKING_BYTES = 5 * 2**20  # of transformed tiles at a time: they stay in the cache
_INPUT: list[list[float]] = [
    [4, 0, -5, 0, 1, 0],
    [0, -4, -4, 1, 1, 0],
    [0, 4, -4, -1, 1, 0],
    [0, -2, -1, 2, 1, 0],
    [0, 2, -1, -2, 1, 0],
    [0, 4, 0, -5, 0, 1],
]
_FILTER: list[list[float]] = [
    [1 / 4, 0, 0],
    [-1 / 6, -1 / 6, -1 / 6],
    [-1 / 6, 1 / 6, -1 / 6],
    [1 / 24, 1 / 12, 1 / 6],
    [1 / 24, -1 / 12, 1 / 6],
    [0, 0, 1],
]
_OUTPUT: list[list[float]] = [[1, 1, 1, 1, 1, 0], [0, 1, -1, 2, -2, 0], [0, 1, 1, 4, 4, 0], [0, 1, -1, 8, -8, 1]]


class WinogradConv2d(nn.Conv2d):
    """A 3x3 ``nn.Conv2d`` of stride 1 and padding 1 that trains on a CPU by F(4x4, 3x3).

    The function is the same to about 1e-5 of its largest value, as is cuDNN's, which does this on a GPU. Elsewhere,
    and where no gradient is asked for, it is ``nn.Conv2d``.

    Shape:
        (B, C, H, W) -> (B, K, H, W).
    """

    def forward(self, input: Tensor) -> Tensor:
        """Convolve."""
        cpu = input.device.type == "cpu" and not torch.is_autocast_enabled("cpu") and not torch.compiler.is_compiling()
        if cpu and self.training and torch.is_grad_enabled():
            return _Winograd.apply(input, self.weight)
        return super().forward(input)


def use_winograd(body: nn.Module) -> None:
    """Replace the convolutions of a module that gain by it; their parameters and names stay."""
    for name, conv in list(body.named_modules()):
        plain = type(conv) is nn.Conv2d and conv.groups == 1 and conv.bias is None and conv.in_channels >= 128
        if plain and (conv.kernel_size, conv.stride, conv.padding, conv.dilation) == ((3, 3), (1, 1), (1, 1), (1, 1)):
            faster = WinogradConv2d(conv.in_channels, conv.out_channels, 3, padding=1, bias=False, device="meta")
            faster.weight = conv.weight
            body.set_submodule(name, faster)


class _Winograd(torch.autograd.Function):
    """The convolution and its gradients; only its input and its weight are kept for them."""

    @staticmethod
    def forward(ctx: Any, image_BCHW: Tensor, weight_KC33: Tensor) -> Tensor:
        ctx.save_for_backward(image_BCHW, weight_KC33)
        image_BHWC, filter_PKC = image_BCHW.permute(0, 2, 3, 1), _transformed(weight_KC33)
        (batch, height, width, channels), out_channels = image_BHWC.shape, len(weight_KC33)
        inward, outward = _matrix(_INPUT, image_BCHW), _matrix(_OUTPUT, image_BCHW)
        result_BHWK = image_BHWC.new_empty(batch, height, width, out_channels)
        for part, result in _parts(image_BHWC, result_BHWK):
            tiles_PTC = (inward @ _windows(part)).view(_WINDOW**2, -1, channels)
            products_PTK = torch.bmm(tiles_PTC, filter_PKC.mT)
            _write_tiles(outward @ products_PTK.flatten(1), result)
        return result_BHWK.permute(0, 3, 1, 2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_BKHW: Tensor) -> tuple[Tensor | None, Tensor | None]:
        image_BCHW, weight_KC33 = ctx.saved_tensors
        image_BHWC, grad_BHWK = image_BCHW.permute(0, 2, 3, 1), grad_BKHW.permute(0, 2, 3, 1)
        filter_PKC = _transformed(weight_KC33)
        (out_channels, channels), (of_image, of_weight) = filter_PKC.shape[1:], ctx.needs_input_grad
        inward, outward = _matrix(_INPUT, image_BCHW), _matrix(_OUTPUT, image_BCHW)
        grad_filter_PKC = torch.zeros_like(filter_PKC)
        grad_image_BHWC = torch.empty_like(image_BHWC, memory_format=torch.contiguous_format)
        for part, grad, grad_image in _parts(image_BHWC, grad_BHWK, grad_image_BHWC):
            grad_products_PTK = (outward.T @ _tiles(grad)).view(_WINDOW**2, -1, out_channels)
            if of_weight:
                tiles_PTC = (inward @ _windows(part)).view(_WINDOW**2, -1, channels)
                torch.baddbmm(grad_filter_PKC, grad_products_PTK.mT, tiles_PTC, out=grad_filter_PKC)
            if of_image:
                grad_tiles_PTC = torch.bmm(grad_products_PTK, filter_PKC)
                _add_windows(inward.T @ grad_tiles_PTC.flatten(1), grad_image)
        grad_weight_9L = _matrix(_FILTER, image_BCHW).T @ grad_filter_PKC.flatten(1)
        grad_weight_KC33 = grad_weight_9L.view(3, 3, out_channels, channels).permute(2, 3, 0, 1)
        return grad_image_BHWC.permute(0, 3, 1, 2) if of_image else None, grad_weight_KC33 if of_weight else None


def _matrix(of_a_line: list[list[float]], like: Tensor) -> Tensor:
    """A transform of square tiles from that of a line."""
    line = like.new_tensor(of_a_line)
    return torch.kron(line, line)


def _transformed(weight_KC33: Tensor) -> Tensor:
    lines_9L = weight_KC33.permute(2, 3, 0, 1).reshape(9, -1)
    return (_matrix(_FILTER, weight_KC33) @ lines_9L).view(_WINDOW**2, *weight_KC33.shape[:2])


def _parts(*tensors_BHWC: Tensor) -> Any:
    """Split batches into as many images as are worked on at a time."""
    _, height, width, channels = tensors_BHWC[0].shape
    tiles = -(-height // _TILE) * -(-width // _TILE)
    images = max(1, _WORKING_BYTES // (_WINDOW**2 * tiles * channels * tensors_BHWC[0].element_size()))
    return zip(*(tensor.split(images) for tensor in tensors_BHWC), strict=True)


def _strided(image_BHWC: Tensor, rows: int, columns: int, at: tuple[int, int] = (0, 0)) -> Tensor:
    """Pixels by their place (rows, columns) in a tile, from ``at`` on: (rows, columns, B, tiles down, across, C)."""
    batch, height, width, channels = image_BHWC.shape
    of_image, of_row, of_pixel, _ = image_BHWC.stride()
    shape = (rows, columns, batch, height // _TILE, width // _TILE, channels)
    strides = (of_row, of_pixel, of_image, _TILE * of_row, _TILE * of_pixel, 1)
    offset = image_BHWC.storage_offset() + at[0] * of_row + at[1] * of_pixel
    return image_BHWC.as_strided(shape, strides, offset)


def _windows(image_BHWC: Tensor) -> Tensor:
    """What the tiles read, overlapping by two pixels: (36, tiles of all images * C)."""
    height, width = image_BHWC.shape[1:3]
    padded = F.pad(image_BHWC, (0, 0, 1, 1 + -width % _TILE, 1, 1 + -height % _TILE)).contiguous()
    return _strided(padded, _WINDOW, _WINDOW).reshape(_WINDOW**2, -1)


def _tiles(image_BHWC: Tensor) -> Tensor:
    """Tiles that do not overlap: (16, tiles of all images * C)."""
    height, width = image_BHWC.shape[1:3]
    whole = F.pad(
        image_BHWC, (0, 0, 0, -width % _TILE, 0, -height % _TILE)
    ).contiguous()  # whatever the gradient's order
    return _strided(whole, _TILE, _TILE).reshape(_TILE**2, -1)


def _write_tiles(tiles_QL: Tensor, image_BHWC: Tensor) -> None:
    """The inverse of :func:`_tiles`."""
    batch, height, width, channels = image_BHWC.shape
    whole = image_BHWC.new_empty(batch, height + -height % _TILE, width + -width % _TILE, channels)
    places = _strided(whole, _TILE, _TILE)
    for column, tiles in enumerate(tiles_QL.view(places.shape).unbind(1)):  # long runs are copied at once
        places[:, column] = tiles
    image_BHWC.copy_(whole[:, :height, :width])


def _add_windows(windows_PL: Tensor, image_BHWC: Tensor) -> None:
    """The adjoint of :func:`_windows`: sums where windows overlap."""
    batch, height, width, channels = image_BHWC.shape
    down, across = -(-height // _TILE), -(-width // _TILE)
    padded = image_BHWC.new_zeros(batch, down * _TILE + 2, across * _TILE + 2, channels)
    windows = windows_PL.view(_WINDOW, _WINDOW, batch, down, across, channels)
    for first, last in ((0, _TILE), (_TILE, _WINDOW)):  # rows that do not overlap
        for column in range(_WINDOW):
            _strided(padded, last - first, 1, (first, column))[:, 0] += windows[first:last, column]
    image_BHWC.copy_(padded[:, 1 : 1 + height, 1 : 1 + width])
