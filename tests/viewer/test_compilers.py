"""The kernels in Chromium's compiler, which is stricter than that of wgpu, with core limits."""

from __future__ import annotations

import json

import pytest
from _needs import lacking

from meshsplats.webgpu import kernels

COMPILE = """(async (source, entries) => {
  const adapter = await navigator.gpu?.requestAdapter();
  if (!adapter) return null;
  const device = await adapter.requestDevice();
  const problems = [];
  device.pushErrorScope('validation');
  const module = device.createShaderModule({code: source});
  for (const message of (await module.getCompilationInfo()).messages)
    problems.push(`${message.lineNum}: ${message.message}`);
  for (const entryPoint of entries) {
    try {
      await device.createComputePipelineAsync({layout: 'auto', compute: {module, entryPoint}});
    } catch (error) {
      problems.push(`${entryPoint}: ${error.message}`);
    }
  }
  const error = await device.popErrorScope();
  if (error) problems.push(error.message);
  device.destroy();
  return problems;
})"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "entries"),
    [
        (kernels.gradients_source(4, groups=True), ("raster", *kernels.GRADIENT_KERNELS)),
        (kernels.gradients_source(order="splat"), ("raster", "add_samples")),
        (kernels.filter_source(), ("widen_backward",)),
        (kernels.training_source(), kernels.TRAINING_KERNELS),
    ],
    ids=["gradients", "by splat", "filter", "training"],
)
def test_kernels_of_gradients_and_training_compile(browser, tmp_path, source, entries):
    """Those of images compile in pages, in test_exact.py; test_dawn.py has every kernel of every text."""
    (tmp_path / "empty.html").write_text("<!doctype html><title>empty</title>")
    page = browser.page((tmp_path / "empty.html").as_uri())
    problems = page.run(f"{COMPILE}({json.dumps(source)}, {json.dumps(entries)})")
    page.close()
    if problems is None:
        lacking("browser", "Chromium has no WebGPU here")
    assert problems == []
