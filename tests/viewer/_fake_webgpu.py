"""A WebGPU that draws nothing, at once: what the page asks of a device, without shaders to compile."""

FAKE_WEBGPU = """
window.gpu = {
  asked: 0, devices: 0, destroyed: 0, refuses: false, full: false, frames: [], lose: null, wait: null,
};
const anything = () => new Proxy(() => {}, {
  get: (_, name) => name === 'then' ? undefined : anything(), apply: () => anything(),
});
class FakeDevice {
  constructor() {
    gpu.devices++;
    this.words = new Uint32Array(16); // the counters of a frame that is done
    this.lost = new Promise(resolve => {
      gpu.lose = message => {
        this.gone = true;
        resolve({ reason: 'unknown', message });
      };
    });
    this.queue = { submit() {}, writeBuffer: (buffer, _, data) => {
      if (!(buffer.usage & GPUBufferUsage.UNIFORM) || !(data instanceof Float32Array) || data.length !== 64)
        return;
      const [width, height, across, down] = new Uint32Array(data.buffer).subarray(28);
      gpu.frames.push([width, height]);
      this.words[2] = across * down;
    } };
  }
  addEventListener() {}
  destroy() { gpu.destroyed++; }
  createShaderModule() { return { getCompilationInfo: async () => ({ messages: [] }) }; }
  async createComputePipelineAsync() { return anything(); }
  async createRenderPipelineAsync() { return anything(); }
  createBindGroup() { return {}; }
  createCommandEncoder() { return anything(); }
  createBuffer({ size, usage }) {
    if (gpu.full) throw new Error('no room');
    const mapAsync = async () => {
      await gpu.wait?.();
      if (this.gone) throw new Error('unmapped');
    };
    return { size, usage, mapAsync, getMappedRange: () => this.words.buffer, unmap() {}, destroy() {} };
  }
}
const limits = { maxStorageBufferBindingSize: 2 ** 27, maxBufferSize: 2 ** 28 };
Object.defineProperty(Navigator.prototype, 'gpu', { get: () => ({
  getPreferredCanvasFormat: () => 'bgra8unorm',
  requestAdapter: async () => {
    gpu.asked++;
    return gpu.refuses ? null : { limits, requestDevice: async () => new FakeDevice() };
  },
}) });
const contextOf = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...words) {
  return kind === 'webgpu' ? anything() : contextOf.call(this, kind, ...words);
};
"""
"""A script for ``browser.page(before=...)``. ``window.gpu``: how often an adapter was ``asked`` for, how many
``devices`` there were and how many the page ``destroyed``, the sizes of the ``frames`` that were drawn;
``lose(message)`` takes the device; no adapter where it ``refuses``, no buffer where it is ``full``; each
frame waits for ``wait()``."""
