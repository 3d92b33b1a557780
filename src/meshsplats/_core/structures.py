"""The structures of csrc/ in Python: types.h, then those of the headers of single functions."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import c_double, c_float, c_int32, c_int64, c_void_p


class CoreStruct(ctypes.Structure):
    """``NameStruct`` mirrors ``MsName``: its fields, in their order."""


def _of(kind: type) -> Callable[..., list[tuple[str, type]]]:
    """Makes fields of that kind, by their names."""
    return lambda *names: [(name, kind) for name in names]


pointers, floats, doubles = _of(c_void_p), _of(c_float), _of(c_double)
int32, int64 = _of(c_int32), _of(c_int64)


class CameraStruct(CoreStruct):
    _fields_ = [
        ("world_to_camera", c_double * 12),
        *doubles("fx", "fy", "cx", "cy", "near"),
        *int32("width", "height"),
    ]


class OptionsStruct(CoreStruct):
    _fields_ = [
        *int32("samples", "max_layers", "threads"),
        *floats("min_transmittance"),
        *pointers("background"),
        *int32("background_per_pixel"),
        *floats("cutoff", "ramp_slope", "ramp_height", "ramp_width", "ramp_leak"),
    ]


class MeshStruct(CoreStruct):
    _fields_ = [
        *int64("vertex_count", "face_count"),
        *pointers("vertices", "colors", "faces", "face_splat", "depth_group", "normals", "attributes"),
        *int32("attribute_count", "by_splat"),
        *doubles("filter_px2"),
    ]


class SplatsStruct(CoreStruct):
    _fields_ = [
        *int64("count"),
        *pointers("means", "quaternions", "scales", "opacities", "sh"),
        *int32("sh_stored", "sh_used", "kernel"),
        *floats("dilation"),
    ]


class ImageStruct(CoreStruct):
    _fields_ = [
        *pointers("color", "alpha", "depth", "normals", "attributes", "median_depth"),
        *int64("fragments"),
    ]


class ImageGradientsStruct(CoreStruct):
    _fields_ = [*pointers("color", "alpha", "attributes", "expected_weight", "target")]


class VertexGradientsStruct(CoreStruct):
    _fields_ = [*pointers("vertices", "colors", "attributes")]


class ComparisonStruct(CoreStruct):
    _fields_ = [
        *int64("count"),
        *int32("height", "width", "channels", "threads"),
        *pointers("image", "target", "mask", "gradient"),
        *floats("l1_weight", "ssim_weight"),
        *doubles("l1", "ssim"),
    ]


class AdamStruct(CoreStruct):
    _fields_ = [
        *int64("rows"),
        *int32("columns", "threads"),
        *pointers("values", "mean", "square", "gradient", "scale", "chosen"),
        *int64("chosen_count"),
        *pointers("mask"),
        *floats("step", "one_minus_beta1", "one_minus_beta2", "epsilon", "low", "high"),
    ]


class FansStruct(CoreStruct):
    _fields_ = [
        *int64("count"),
        *int32("sides", "threads"),
        *pointers("vertices", "polygon"),
        *doubles("share"),
    ]


class EdgesStruct(CoreStruct):
    _fields_ = [
        *int32("width", "height", "samples", "threads"),
        *int64("vertex_count", "face_count"),
        *pointers("screen", "colors", "faces", "across", "front", "color", "gradient"),
        *doubles("near", "cutoff"),
        *pointers("result"),
    ]


class ShadingStruct(CoreStruct):
    _fields_ = [
        *int64("vertex_count", "face_count", "splat_count"),
        *int32("terms", "threads"),
        *pointers("vertices", "colors", "faces", "face_splat", "harmonics"),
        ("eye", c_double * 3),
        *pointers("shaded", "gradient", "color_gradient", "harmonic_gradient"),
    ]


class ViewerStruct(CoreStruct):
    _fields_ = [
        ("camera", CameraStruct),
        *int64("vertex_count", "face_count"),
        *pointers("vertices", "colors", "faces", "background", "cutoffs", "color"),
        *int32("image_count", "multisample", "culled", "threads"),
    ]


class FusingStruct(CoreStruct):
    _fields_ = [
        ("camera", CameraStruct),
        ("size", c_int64 * 3),
        ("low", c_double * 3),
        *doubles("voxel"),
        ("center", c_double * 3),
        *doubles("radius", "truncation", "behind"),
        *pointers("depth", "sum", "weight"),
        *int32("threads"),
    ]


class TextureStruct(CoreStruct):
    _fields_ = [
        *int32("rows", "columns", "samples", "threads", "height", "width"),
        *pointers("uv", "covered", "texels", "color", "gradient", "texel_sums", "uv_gradient"),
        *floats("share", "doubt"),
        *pointers("relaxed"),
    ]


class OrderingStruct(CoreStruct):
    _fields_ = [
        *int64("vertex_count", "face_count", "piece_count"),
        *pointers(
            "vertices", "colors", "faces", "turned", "piece_start", "centers", "splat", "node", "cameras"
        ),
        *int32("camera_count", "sweeps", "threads"),
        *int64("max_pairs"),
        *pointers("rank"),
        *int64("pairs"),
        *doubles("weight", "before", "after"),
    ]


class ListingStruct(CoreStruct):
    _fields_ = [
        ("camera", CameraStruct),
        *int64("vertex_count", "face_count"),
        *pointers("vertices", "faces", "face_splat", "copies", "starts", "listed", "listed_splat"),
        *int32("node_count", "threads"),
    ]


class NearestStruct(CoreStruct):
    _fields_ = [*int64("count"), *int32("neighbours", "threads"), *pointers("points", "order", "nearest")]


class MergingStruct(CoreStruct):
    _fields_ = [
        *int64("count", "wanted"),
        *int32("neighbours", "threads"),
        *pointers("means", "covariances", "masses", "colors", "nearest"),
        *doubles("color_weight"),
        *pointers("group"),
        *int64("remaining"),
    ]


class ViewsStruct(CoreStruct):
    _fields_ = [*pointers("cameras", "start"), *int32("count", "threads")]


class MatchingStruct(CoreStruct):
    _fields_ = [
        ("photos", ViewsStruct),
        *pointers("color"),
        ("matched", ViewsStruct),
        *pointers("photo", "sources", "range", "inverse", "along_x", "along_y", "score"),
        *int32("source_count", "planes", "rounds"),
    ]


class ConsistencyStruct(CoreStruct):
    _fields_ = [
        ("views", ViewsStruct),
        *pointers("inverse", "others", "neighbors", "agree", "past", "seen"),
        *floats("tolerance", "past_tolerance"),
        *int32("neighbor_count"),
    ]


class FillingStruct(CoreStruct):
    _fields_ = [
        ("views", ViewsStruct),
        *pointers("color", "inverse", "along_x", "along_y", "known", "result"),
        *floats("per_pixel"),
    ]


class NearestVerticesStruct(CoreStruct):
    _fields_ = [
        *pointers("places", "normals", "ids", "vertices", "vertex_normals", "index", "found"),
        *int64("count"),
        ("size", c_int64 * 3),
        ("low", c_double * 3),
        *doubles("side", "facing_away"),
        *int32("reach", "threads"),
    ]


class CellSumsStruct(CoreStruct):
    _fields_ = [
        *pointers("points", "cell", "beside", "middle", "values", "total"),
        *int64("count"),
        *int32("around", "channels"),
        *doubles("falloff"),
        *int32("threads"),
    ]


class ResamplingStruct(CoreStruct):
    _fields_ = [
        *pointers("points", "bytes", "values", "result"),
        *int64("count"),
        *int32("height", "width", "channels", "wraps", "threads"),
    ]


class CarvingStruct(CoreStruct):
    _fields_ = [
        ("views", ViewsStruct),
        *pointers("inverse", "points", "agree", "past"),
        *int64("count"),
        *floats("tolerance", "past_tolerance"),
    ]


class FusionStruct(CoreStruct):
    _fields_ = [
        *pointers("points", "normals", "pixels", "colors", "sure", "patches"),
        *int64("count"),
        *int32("wanted", "threads"),
        *floats("largest"),
        *int32("found"),
    ]
