"""Images of meshes on any GPU, by WebGPU. See :mod:`meshsplats.webgpu.renderer`."""
