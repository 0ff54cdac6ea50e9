"""Resizing, cropping and scaling inside of the model, so that an app feeds it an image as it is."""

from __future__ import annotations

import numpy as np
import onnx

from mambaloc.images import Image, resized_size
from mambaloc.runtime.contract import IMAGE_INPUT, INTRINSICS_INPUT, MAX_ENLARGEMENT, RAW_INPUT, Preprocessing

_PREFIX = "preprocessing_"  # of the names inside
_TIE = 2e-4  # levels from halfway


def with_preprocessing(
    model: onnx.ModelProto, preprocessing: Preprocessing, focal_px: float | None = None
) -> onnx.ModelProto:
    """Put :class:`Preprocessing` before a network, as operators that every build of ONNX Runtime has.

    Averaging areas is a product with the overlaps of old and new pixels, once for rows and once for columns. Rows come
    first and of all channels at once: only what is left is transposed. Where an image is exactly halved, OpenCV rounds
    halves up, not to even: an eighth added to quarters does.

    Args:
        model: the network.
        preprocessing: of its input.
        focal_px: of the training camera in the network's input, for a network that takes intrinsics. Then images are
            resized as :meth:`~mambaloc.runtime.contract.Contract.preprocessing_for` says.

    Shape:
        rgb (height, width, 3) ``uint8`` of any size, and perhaps intrinsics (1, 3, 3) in its pixels -> the network's
        outputs, batch 1.
    """
    height, width = preprocessing.crop
    opset = next(o.version for o in model.opset_import if o.domain in ("", "ai.onnx"))
    short_side, io_map, given, passed_on = float(preprocessing.short_side), [("network_input", IMAGE_INPUT)], "", ""
    if focal_px:
        io_map.append(("network_intrinsics", INTRINSICS_INPUT))
        given, passed_on = f", float[1, 3, 3] {INTRINSICS_INPUT}", ", float[1, 3, 3] network_intrinsics"
    front = onnx.parser.parse_model(f"""
        <ir_version: {model.ir_version}, opset_import: ["": {opset}]>
        preprocessing (uint8[height, width, 3] {RAW_INPUT}{given})
            => (float[1, 3, {height}, {width}] network_input{passed_on})
        <
            {_camera_constants(preprocessing, focal_px) if focal_px else f"float short_side = {{{short_side}}},"}
            float white = {{255.0}}, float none = {{0.0}}, float two_f = {{2.0}},
            float eighth = {{0.125}}, int64 zero = {{0}}, int64 one = {{1}},
            int64[1] first = {{0}}, int64[1] second = {{1}}, int64[1] third = {{2}}, int64[1] two = {{2}},
            int64[1] channels = {{3}}, int64[2] row_by_row = {{0, -1}},
            int64[2] axes = {{2, 3}}, int64[2] crop = {{{height}, {width}}}
        >
        {{
            shape = Shape({RAW_INPUT})
            size = Slice(shape, first, third)
            size_f = Cast<to = 1>(size)
            shorter = ReduceMin<keepdims = 0>(size_f)
            {_SHORT_SIDE_OF_CAMERA if focal_px else ""}
            scale = Div(short_side, shorter)
            scaled = Mul(size_f, scale)
            new_size_f = Round(scaled)
            new_size = Cast<to = 7>(new_size_f)
            {_overlaps("rows", "first", "second")}
            {_overlaps("columns", "second", "third")}
            levels = Cast<to = 1>({RAW_INPUT})
            interleaved = Reshape(levels, row_by_row)
            fewer_interleaved = MatMul(rows_weight, interleaved)
            fewer_shape = Concat<axis = 0>(rows_new_1, columns_old_1, channels)
            fewer_pixels = Reshape(fewer_interleaved, fewer_shape)
            fewer_rows = Transpose<perm = [2, 0, 1]>(fewer_pixels)
            columns_weight_t = Transpose<perm = [1, 0]>(columns_weight)
            resized = MatMul(fewer_rows, columns_weight_t)
            doubled = Mul(new_size_f, two_f)
            is_doubled = Equal(doubled, size_f)
            is_doubled_f = Cast<to = 1>(is_doubled)
            is_halved = ReduceMin<keepdims = 0>(is_doubled_f)
            nudge = Mul(is_halved, eighth)
            nudged = Add(resized, nudge)
            whole = Round(nudged)
            batch = Unsqueeze(whole, first)
            {_CROP_OF_CAMERA if focal_px else _CROP}
            network_input = Div(cropped, white)
        }}
    """)
    merged = onnx.compose.merge_models(front, model, io_map=io_map, prefix1=_PREFIX)
    for tensor in merged.graph.input:
        prefixed, tensor.name = tensor.name, tensor.name.removeprefix(_PREFIX)
        for node in merged.graph.node:
            node.input[:] = [tensor.name if name == prefixed else name for name in node.input]
    return merged


def ties_rounded_otherwise(rgb: Image, preprocessing: Preprocessing) -> Image:
    """Preprocess an image, and round each level halfway between two whole ones the other way; (H, W, 3) -> (*crop, 3).

    In float32 the order of a sum decides such a level, and no two processors or libraries add in the same order. Images
    that become 2, 4, 8 ... times smaller have weights that a float32 holds exactly, and no such levels.
    """
    new = resized_size(rgb.shape[:2], preprocessing.short_side)
    if all(old % size == 0 and (old // size).bit_count() == 1 for old, size in zip(rgb.shape[:2], new, strict=True)):
        return preprocessing.apply(rgb)
    rounded, exact = preprocessing.apply(rgb), preprocessing.apply(rgb.astype(np.float32))
    below = np.floor(exact)
    is_tie = np.abs(exact - below - 0.5) < _TIE
    return np.where(is_tie, 2 * below + 1 - rounded, rounded).clip(0, 255).astype(np.uint8)


_CROP = """
            spare = Sub(new_size, crop)
            start = Div(spare, two)
            end = Add(start, crop)
            cropped = Slice(batch, start, end, axes)"""

_SHORT_SIDE_OF_CAMERA = """
            numbers = Reshape(intrinsics, nine)
            fx = Slice(numbers, first, second)
            times_focal = Mul(shorter, focal)
            as_large = Div(times_focal, fx)
            rounded = Round(as_large)
            at_least = Max(rounded, one_f)
            at_most = Min(at_least, largest)
            short_side = Squeeze(at_most)"""

_CROP_OF_CAMERA = """
            missing_signed = Sub(crop, new_size)
            missing = Max(missing_signed, zero)
            missing_and_one = Add(missing, one)
            before = Div(missing_and_one, two)
            after = Sub(missing, before)
            borders = Concat<axis = 0>(before, after)
            bordered = Pad(batch, borders, none, axes)
            bordered_size = Add(new_size, missing)
            spare = Sub(bordered_size, crop)
            start = Div(spare, two)
            end = Add(start, crop)
            cropped = Slice(bordered, start, end, axes)
            corner = Sub(start, before)
            corner_f = Cast<to = 1>(corner)
            ratio = Div(new_size_f, size_f)
            larger = Sub(ratio, one_f)
            centres = Mul(larger, half)
            shift = Sub(centres, corner_f)
            ratio_xy = Gather(ratio, x_after_y)
            shift_xy = Gather(shift, x_after_y)
            ratios = Concat<axis = 0>(ratio_xy, ones)
            shifts = Concat<axis = 0>(shift_xy, nones)
            ratio_column = Reshape(ratios, column)
            shift_column = Reshape(shifts, column)
            shift_last = Mul(shift_column, last)
            rescaled = Mul(intrinsics, ratio_column)
            network_intrinsics = Add(rescaled, shift_last)"""


def _camera_constants(preprocessing: Preprocessing, focal_px: float) -> str:
    largest = float(MAX_ENLARGEMENT * preprocessing.short_side)
    return f"""
            float one_f = {{1.0}},
            float focal = {{{focal_px}}}, float largest = {{{largest}}}, float half = {{0.5}}, int64[1] nine = {{9}},
            float[1] ones = {{1.0}}, float[1] nones = {{0.0}}, float[1, 3] last = {{0.0, 0.0, 1.0}},
            int64[2] x_after_y = {{1, 0}}, int64[2] column = {{3, 1}},"""


def _overlaps(axis: str, begin: str, end: str) -> str:
    """Share of each old pixel (columns) in each new one (rows): how far their extents overlap, by the new one's.

    Old pixels are as many parts long as there are new ones, and the other way about: whole numbers, exact in float32.
    """
    return f"""
            {axis}_old_1 = Slice(size, {begin}, {end})
            {axis}_new_1 = Slice(new_size, {begin}, {end})
            {axis}_old = Squeeze({axis}_old_1)
            {axis}_new = Squeeze({axis}_new_1)
            {axis}_old_f = Cast<to = 1>({axis}_old)
            {axis}_new_f = Cast<to = 1>({axis}_new)
            {axis}_j_int = Range(zero, {axis}_old, one)
            {axis}_j_float = Cast<to = 1>({axis}_j_int)
            {axis}_j_row = Unsqueeze({axis}_j_float, first)
            {axis}_j = Mul({axis}_j_row, {axis}_new_f)
            {axis}_j_end = Add({axis}_j, {axis}_new_f)
            {axis}_i_int = Range(zero, {axis}_new, one)
            {axis}_i_float = Cast<to = 1>({axis}_i_int)
            {axis}_i_column = Unsqueeze({axis}_i_float, second)
            {axis}_i = Mul({axis}_i_column, {axis}_old_f)
            {axis}_i_end = Add({axis}_i, {axis}_old_f)
            {axis}_from = Max({axis}_i, {axis}_j)
            {axis}_to = Min({axis}_i_end, {axis}_j_end)
            {axis}_signed = Sub({axis}_to, {axis}_from)
            {axis}_overlap = Max({axis}_signed, none)
            {axis}_weight = Div({axis}_overlap, {axis}_old_f)"""
