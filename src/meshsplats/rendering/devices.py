"""The engine of a device."""

from __future__ import annotations

from meshsplats._common.choices import Device
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.engine import Engine, check_device
from meshsplats.rendering.gpu import gpu_engine


def engine(device: Device, threads: int | None = None) -> Engine:
    """What draws on ``device``, with at most ``threads`` of the processor; None: all processors.

    There is one GPU engine in a process, whose meshes stay on the GPU. ValueError for another device.
    """
    check_device(device)
    return CpuEngine(threads) if device == "cpu" else gpu_engine()
