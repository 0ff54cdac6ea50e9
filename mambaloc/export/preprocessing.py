"""Resizing, cropping and scaling inside of the model, so that an app feeds it a picture as it is."""

from __future__ import annotations

import onnx

from mambaloc.runtime.contract import RAW_INPUT, Preprocessing

_PREFIX = "preprocessing_"  # of the names inside


def with_preprocessing(model: onnx.ModelProto, preprocessing: Preprocessing) -> onnx.ModelProto:
    """Put :class:`Preprocessing` before a network, as operators that every build of ONNX Runtime has.

    Averaging areas is a product with the overlaps of old and new pixels, once for rows and once for columns.

    Shape:
        rgb (height, width, 3) ``uint8`` of any size -> the network's outputs, batch 1.
    """
    height, width = preprocessing.crop
    opset = next(o.version for o in model.opset_import if o.domain in ("", "ai.onnx"))
    front = onnx.parser.parse_model(f"""
        <ir_version: {model.ir_version}, opset_import: ["": {opset}]>
        preprocessing (uint8[height, width, 3] {RAW_INPUT}) => (float[1, 3, {height}, {width}] network_input)
        <
            float short_side = {{{float(preprocessing.short_side)}}},
            float white = {{255.0}}, float one_f = {{1.0}}, float none = {{0.0}}, int64 zero = {{0}}, int64 one = {{1}},
            int64[1] first = {{0}}, int64[1] second = {{1}}, int64[1] third = {{2}}, int64[1] two = {{2}},
            int64[2] axes = {{2, 3}}, int64[2] crop = {{{height}, {width}}}
        >
        {{
            shape = Shape({RAW_INPUT})
            size = Slice(shape, first, third)
            size_f = Cast<to = 1>(size)
            shorter = ReduceMin<keepdims = 0>(size_f)
            scale = Div(short_side, shorter)
            scaled = Mul(size_f, scale)
            new_size_f = Round(scaled)
            new_size = Cast<to = 7>(new_size_f)
            {_overlaps("rows", "first", "second")}
            {_overlaps("columns", "second", "third")}
            levels = Cast<to = 1>({RAW_INPUT})
            planar = Transpose<perm = [2, 0, 1]>(levels)
            fewer_rows = MatMul(rows_weight, planar)
            columns_weight_t = Transpose<perm = [1, 0]>(columns_weight)
            resized = MatMul(fewer_rows, columns_weight_t)
            whole = Round(resized)
            batch = Unsqueeze(whole, first)
            spare = Sub(new_size, crop)
            start = Div(spare, two)
            end = Add(start, crop)
            cropped = Slice(batch, start, end, axes)
            network_input = Div(cropped, white)
        }}
    """)
    merged = onnx.compose.merge_models(front, model, io_map=[("network_input", "image")], prefix1=_PREFIX)
    for node in merged.graph.node:
        node.input[:] = [RAW_INPUT if name == _PREFIX + RAW_INPUT else name for name in node.input]
    merged.graph.input[0].name = RAW_INPUT
    return merged


def _overlaps(axis: str, begin: str, end: str) -> str:
    """Share of each old pixel (columns) in each new one (rows): how far their extents overlap, by the new one's."""
    return f"""
            {axis}_old_1 = Slice(size, {begin}, {end})
            {axis}_new_1 = Slice(new_size, {begin}, {end})
            {axis}_old = Squeeze({axis}_old_1)
            {axis}_new = Squeeze({axis}_new_1)
            {axis}_old_f = Cast<to = 1>({axis}_old)
            {axis}_new_f = Cast<to = 1>({axis}_new)
            {axis}_step = Div({axis}_old_f, {axis}_new_f)
            {axis}_j_int = Range(zero, {axis}_old, one)
            {axis}_j_row = Cast<to = 1>({axis}_j_int)
            {axis}_j = Unsqueeze({axis}_j_row, first)
            {axis}_j_end = Add({axis}_j, one_f)
            {axis}_i_int = Range(zero, {axis}_new, one)
            {axis}_i_row = Cast<to = 1>({axis}_i_int)
            {axis}_i_column = Unsqueeze({axis}_i_row, second)
            {axis}_i = Mul({axis}_i_column, {axis}_step)
            {axis}_i_end = Add({axis}_i, {axis}_step)
            {axis}_from = Max({axis}_i, {axis}_j)
            {axis}_to = Min({axis}_i_end, {axis}_j_end)
            {axis}_signed = Sub({axis}_to, {axis}_from)
            {axis}_overlap = Max({axis}_signed, none)
            {axis}_weight = Div({axis}_overlap, {axis}_step)"""
