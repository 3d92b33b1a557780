"""The structures of csrc/ in Python: types.h, then those of the headers of single functions."""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_float, c_int32, c_int64, c_void_p


class CoreStruct(ctypes.Structure):
    """``NameStruct`` mirrors ``MsName``: its fields, in their order."""


class CameraStruct(CoreStruct):
    _fields_ = [
        ("world_to_camera", c_double * 12),
        ("fx", c_double),
        ("fy", c_double),
        ("cx", c_double),
        ("cy", c_double),
        ("near", c_double),
        ("width", c_int32),
        ("height", c_int32),
    ]


class OptionsStruct(CoreStruct):
    _fields_ = [
        ("samples", c_int32),
        ("max_layers", c_int32),
        ("threads", c_int32),
        ("min_transmittance", c_float),
        ("background", c_void_p),
        ("background_per_pixel", c_int32),
        ("cutoff", c_float),
        ("ramp_slope", c_float),
        ("ramp_height", c_float),
        ("ramp_width", c_float),
        ("ramp_leak", c_float),
    ]


class MeshStruct(CoreStruct):
    _fields_ = [
        ("vertex_count", c_int64),
        ("face_count", c_int64),
        ("vertices", c_void_p),
        ("colors", c_void_p),
        ("faces", c_void_p),
        ("face_splat", c_void_p),
        ("depth_group", c_void_p),
        ("normals", c_void_p),
        ("attributes", c_void_p),
        ("attribute_count", c_int32),
        ("by_splat", c_int32),
        ("filter_px2", c_double),
    ]


class SplatsStruct(CoreStruct):
    _fields_ = [
        ("count", c_int64),
        ("means", c_void_p),
        ("quaternions", c_void_p),
        ("scales", c_void_p),
        ("opacities", c_void_p),
        ("sh", c_void_p),
        ("sh_stored", c_int32),
        ("sh_used", c_int32),
        ("kernel", c_int32),
        ("dilation", c_float),
    ]


class ImageStruct(CoreStruct):
    _fields_ = [
        ("color", c_void_p),
        ("alpha", c_void_p),
        ("depth", c_void_p),
        ("normals", c_void_p),
        ("attributes", c_void_p),
        ("fragments", c_int64),
    ]


class ImageGradientsStruct(CoreStruct):
    _fields_ = [
        ("color", c_void_p),
        ("alpha", c_void_p),
        ("attributes", c_void_p),
        ("expected_weight", c_void_p),
        ("target", c_void_p),
    ]


class VertexGradientsStruct(CoreStruct):
    _fields_ = [("vertices", c_void_p), ("colors", c_void_p), ("attributes", c_void_p)]


class ComparisonStruct(CoreStruct):
    _fields_ = [
        ("count", c_int64),
        ("height", c_int32),
        ("width", c_int32),
        ("channels", c_int32),
        ("threads", c_int32),
        ("image", c_void_p),
        ("target", c_void_p),
        ("mask", c_void_p),
        ("gradient", c_void_p),
        ("l1_rate", c_float),
        ("ssim_rate", c_float),
        ("l1", c_double),
        ("ssim", c_double),
    ]


class AdamStruct(CoreStruct):
    _fields_ = [
        ("rows", c_int64),
        ("columns", c_int32),
        ("threads", c_int32),
        ("values", c_void_p),
        ("mean", c_void_p),
        ("square", c_void_p),
        ("gradient", c_void_p),
        ("scale", c_void_p),
        ("chosen", c_void_p),
        ("chosen_count", c_int64),
        ("mask", c_void_p),
        ("step", c_float),
        ("one_minus_beta1", c_float),
        ("one_minus_beta2", c_float),
        ("epsilon", c_float),
        ("low", c_float),
        ("high", c_float),
    ]


class FansStruct(CoreStruct):
    _fields_ = [
        ("count", c_int64),
        ("sides", c_int32),
        ("threads", c_int32),
        ("vertices", c_void_p),
        ("polygon", c_void_p),
        ("share", c_double),
    ]


class EdgesStruct(CoreStruct):
    _fields_ = [
        ("width", c_int32),
        ("height", c_int32),
        ("samples", c_int32),
        ("threads", c_int32),
        ("vertex_count", c_int64),
        ("face_count", c_int64),
        ("screen", c_void_p),
        ("colors", c_void_p),
        ("faces", c_void_p),
        ("across", c_void_p),
        ("front", c_void_p),
        ("color", c_void_p),
        ("gradient", c_void_p),
        ("near", c_double),
        ("cutoff", c_double),
        ("result", c_void_p),
    ]


class ShadingStruct(CoreStruct):
    _fields_ = [
        ("vertex_count", c_int64),
        ("face_count", c_int64),
        ("splat_count", c_int64),
        ("terms", c_int32),
        ("threads", c_int32),
        ("vertices", c_void_p),
        ("colors", c_void_p),
        ("faces", c_void_p),
        ("face_splat", c_void_p),
        ("harmonics", c_void_p),
        ("eye", c_double * 3),
        ("shaded", c_void_p),
        ("gradient", c_void_p),
        ("color_gradient", c_void_p),
        ("harmonic_gradient", c_void_p),
    ]


class ViewerStruct(CoreStruct):
    _fields_ = [
        ("camera", CameraStruct),
        ("vertex_count", c_int64),
        ("face_count", c_int64),
        ("vertices", c_void_p),
        ("colors", c_void_p),
        ("faces", c_void_p),
        ("background", c_void_p),
        ("cutoffs", c_void_p),
        ("color", c_void_p),
        ("image_count", c_int32),
        ("multisample", c_int32),
        ("culled", c_int32),
        ("threads", c_int32),
    ]


class FusingStruct(CoreStruct):
    _fields_ = [
        ("camera", CameraStruct),
        ("size", c_int64 * 3),
        ("low", c_double * 3),
        ("voxel", c_double),
        ("center", c_double * 3),
        ("radius", c_double),
        ("truncation", c_double),
        ("behind", c_double),
        ("depth", c_void_p),
        ("sum", c_void_p),
        ("weight", c_void_p),
        ("threads", c_int32),
    ]


class TextureStruct(CoreStruct):
    _fields_ = [
        ("rows", c_int32),
        ("columns", c_int32),
        ("samples", c_int32),
        ("threads", c_int32),
        ("height", c_int32),
        ("width", c_int32),
        ("uv", c_void_p),
        ("covered", c_void_p),
        ("texels", c_void_p),
        ("color", c_void_p),
        ("gradient", c_void_p),
        ("texel_sums", c_void_p),
        ("uv_gradient", c_void_p),
    ]


class OrderingStruct(CoreStruct):
    _fields_ = [
        ("vertex_count", c_int64),
        ("face_count", c_int64),
        ("piece_count", c_int64),
        ("vertices", c_void_p),
        ("colors", c_void_p),
        ("faces", c_void_p),
        ("turned", c_void_p),
        ("piece_start", c_void_p),
        ("centers", c_void_p),
        ("splat", c_void_p),
        ("node", c_void_p),
        ("cameras", c_void_p),
        ("camera_count", c_int32),
        ("sweeps", c_int32),
        ("threads", c_int32),
        ("max_pairs", c_int64),
        ("rank", c_void_p),
        ("pairs", c_int64),
        ("weight", c_double),
        ("before", c_double),
        ("after", c_double),
    ]


class ListingStruct(CoreStruct):
    _fields_ = [
        ("camera", CameraStruct),
        ("vertex_count", c_int64),
        ("face_count", c_int64),
        ("vertices", c_void_p),
        ("faces", c_void_p),
        ("face_splat", c_void_p),
        ("copies", c_void_p),
        ("starts", c_void_p),
        ("listed", c_void_p),
        ("listed_splat", c_void_p),
        ("node_count", c_int32),
        ("threads", c_int32),
    ]


class NearestStruct(CoreStruct):
    _fields_ = [
        ("count", c_int64),
        ("neighbours", c_int32),
        ("threads", c_int32),
        ("points", c_void_p),
        ("order", c_void_p),
        ("nearest", c_void_p),
    ]


class MergingStruct(CoreStruct):
    _fields_ = [
        ("count", c_int64),
        ("wanted", c_int64),
        ("neighbours", c_int32),
        ("threads", c_int32),
        ("means", c_void_p),
        ("covariances", c_void_p),
        ("masses", c_void_p),
        ("colors", c_void_p),
        ("nearest", c_void_p),
        ("color_weight", c_double),
        ("group", c_void_p),
        ("remaining", c_int64),
    ]


class ViewsStruct(CoreStruct):
    _fields_ = [
        ("cameras", c_void_p),
        ("start", c_void_p),
        ("count", c_int32),
        ("threads", c_int32),
    ]


class MatchingStruct(CoreStruct):
    _fields_ = [
        ("photos", ViewsStruct),
        ("color", c_void_p),
        ("matched", ViewsStruct),
        ("photo", c_void_p),
        ("sources", c_void_p),
        ("range", c_void_p),
        ("inverse", c_void_p),
        ("along_x", c_void_p),
        ("along_y", c_void_p),
        ("score", c_void_p),
        ("source_count", c_int32),
        ("planes", c_int32),
        ("rounds", c_int32),
    ]


class WitnessesStruct(CoreStruct):
    _fields_ = [
        ("views", ViewsStruct),
        ("inverse", c_void_p),
        ("others", c_void_p),
        ("judges", c_void_p),
        ("agree", c_void_p),
        ("past", c_void_p),
        ("seen", c_void_p),
        ("tolerance", c_float),
        ("past_tolerance", c_float),
        ("judge_count", c_int32),
    ]


class FillingStruct(CoreStruct):
    _fields_ = [
        ("views", ViewsStruct),
        ("color", c_void_p),
        ("inverse", c_void_p),
        ("along_x", c_void_p),
        ("along_y", c_void_p),
        ("known", c_void_p),
        ("result", c_void_p),
        ("per_pixel", c_float),
    ]


class ResamplingStruct(CoreStruct):
    _fields_ = [
        ("points", c_void_p),
        ("bytes", c_void_p),
        ("values", c_void_p),
        ("result", c_void_p),
        ("count", c_int64),
        ("height", c_int32),
        ("width", c_int32),
        ("channels", c_int32),
        ("wraps", c_int32),
        ("threads", c_int32),
    ]


class CarvingStruct(CoreStruct):
    _fields_ = [
        ("views", ViewsStruct),
        ("inverse", c_void_p),
        ("points", c_void_p),
        ("agree", c_void_p),
        ("past", c_void_p),
        ("count", c_int64),
        ("tolerance", c_float),
        ("past_tolerance", c_float),
    ]


class FusionStruct(CoreStruct):
    _fields_ = [
        ("points", c_void_p),
        ("normals", c_void_p),
        ("pixels", c_void_p),
        ("colors", c_void_p),
        ("sure", c_void_p),
        ("patches", c_void_p),
        ("count", c_int64),
        ("wanted", c_int32),
        ("threads", c_int32),
        ("largest", c_float),
        ("found", c_int32),
    ]
