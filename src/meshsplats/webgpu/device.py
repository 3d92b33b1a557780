"""The GPU: its adapter and its device."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterator
from typing import Any

from meshsplats.errors import DeviceError, MissingDependencyError

GET_WGPU = 'pip install "meshsplats[gpu]"'

BACKENDS = ("Vulkan", "Metal", "D3D12")
KINDS = ("DiscreteGPU", "IntegratedGPU", "Unknown", "CPU")
"""Kinds of adapters, the best first."""

CORE_BINDING = 128 << 20
"""Bytes of a storage buffer that a shader can see, on every device."""
MOST_BINDING = 2 << 30
"""Bytes of a buffer that is asked for: where a device has more, nothing needs it."""

CORE_LIMITS = {
    "max-buffer-size": 256 << 20,
    "max-storage-buffer-binding-size": CORE_BINDING,
    "max-storage-buffers-per-shader-stage": 8,
    "max-compute-workgroup-storage-size": 16 << 10,
    "max-compute-invocations-per-workgroup": 256,
    "max-compute-workgroups-per-dimension": 65535,
}
"""What every device has."""

BUDGET = 4_000_000
"""Loop iterations of one walk through a tile list. Drivers end what runs too long, some without an error."""
SOFTWARE_BUDGETS = (60_000, 150_000)
"""The same for software drivers, one after the other until all tiles are finished. lavapipe cuts loops after
65,535 iterations of an invocation; they are counted high, so the first is never cut, the second seldom."""


class Device:
    """A device with WebGPU's core limits: no features, 8 storage buffers a stage. Its buffers may be as large
    as the adapter has them.

    Attributes:
        binding_limit: most bytes of a buffer, a multiple of 16.
    """

    def __init__(self, adapter: Any) -> None:
        self.info: dict[str, str] = {key: str(value) for key, value in dict(adapter.info).items()}
        sizes = ("max-buffer-size", "max-storage-buffer-binding-size")
        largest = min(MOST_BINDING, *(adapter.limits[name] for name in sizes))
        self.binding_limit = max(CORE_BINDING, largest // 16 * 16)
        limits = CORE_LIMITS | {name: max(CORE_LIMITS[name], self.binding_limit) for name in sizes}
        self.device: Any = adapter.request_device_sync(required_limits=limits)
        self._process = os.getpid()
        self.budgets = SOFTWARE_BUDGETS if self.info["adapter_type"] == "CPU" else (BUDGET,)
        self._pipelines: dict[tuple[Any, ...], Any] = {}
        self._modules: dict[tuple[Any, ...], Any] = {}

    def pipeline(self, entry: str, key: tuple[Any, ...], source: Callable[[], str]) -> Any:
        """The pipeline of a kernel, compiled on first use; ``key`` stands for the text of ``source``."""
        import wgpu

        name = (entry, *key)
        if name not in self._pipelines:
            if key not in self._modules:
                self._modules[key] = self.device.create_shader_module(code=source())
            self._pipelines[name] = self.device.create_compute_pipeline(
                layout=wgpu.AutoLayoutMode.auto, compute={"module": self._modules[key], "entry_point": entry}
            )
        return self._pipelines[name]

    def check_process(self) -> None:
        """Raises DeviceError in a process that was forked from the one that opened the device: drivers wait
        there forever."""
        if os.getpid() != self._process:
            raise DeviceError(
                "this process was forked from one that uses the GPU, and no driver works in both: start"
                " processes with multiprocessing.get_context('spawn')"
            )

    @property
    def name(self) -> str:
        """Name of the adapter, its kind and the interface to it."""
        info = self.info
        kind = {"CPU": "software", "DiscreteGPU": "GPU", "IntegratedGPU": "integrated GPU"}
        return f"{info['device']} ({kind.get(info['adapter_type'], 'unknown kind')}, {info['backend_type']})"


@contextlib.contextmanager
def _without_display() -> Iterator[None]:
    """Without a session, Mesa's choice of the display's GPU only writes an error line to stderr: left out."""
    name = "NODEVICE_SELECT"
    if os.environ.get("XDG_RUNTIME_DIR") or name in os.environ:
        yield
        return
    os.environ[name] = "1"
    try:
        yield
    finally:
        del os.environ[name]


def find_adapters() -> list[Any]:
    """The adapters of this machine, the best first.

    Raises:
        MissingDependencyError: wgpu is not installed or cannot be loaded.
    """
    try:
        import wgpu
    except ImportError as error:
        raise MissingDependencyError(f"the GPU needs wgpu ({error}): {GET_WGPU}") from None
    try:
        with _without_display():
            adapters = list(wgpu.gpu.enumerate_adapters_sync())
    except (RuntimeError, OSError) as error:
        raise MissingDependencyError(f"wgpu finds no graphics driver: {error}") from None

    def rank(adapter: Any) -> int:
        kind = adapter.info["adapter_type"]
        return KINDS.index(kind) if kind in KINDS else KINDS.index("Unknown")

    return sorted((a for a in adapters if a.info["backend_type"] in BACKENDS), key=rank)


@functools.lru_cache(maxsize=1)
def open_device() -> Device:
    """The best device of this machine; the same one on every call.

    Raises:
        MissingDependencyError: there is no wgpu or no driver.
        DeviceError: the driver refuses.
    """
    adapters = find_adapters()
    if not adapters:
        raise MissingDependencyError(
            "no GPU was found: it needs a driver for Vulkan, Metal or Direct3D 12 (on Linux without a GPU,"
            " that of mesa-vulkan-drivers draws on processors, slowly)"
        )
    try:
        return Device(adapters[0])
    except RuntimeError as error:
        raise DeviceError(f"{adapters[0].info['device']}: the driver refuses: {error}") from None
