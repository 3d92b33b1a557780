"""Pages that draw with one WebGPU device: its kernels, seconds of a processor each, are compiled once."""

from __future__ import annotations

import contextlib
import functools
import json
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from _browser import Browser, Page

KEEPER = """<!doctype html><title>keeper</title><script>
const modules = new Map(), pipelines = new Map(), codes = new WeakMap(), { prototype } = GPUDevice;
const { createShaderModule, createComputePipelineAsync, createBuffer } = prototype;
prototype.createShaderModule = function (what) {
  if (!modules.has(what.code)) {
    const module = createShaderModule.call(this, what), info = module.getCompilationInfo();
    module.getCompilationInfo = () => info; // asked again, for another page, it never answers
    modules.set(what.code, module);
    codes.set(module, what.code);
  }
  return modules.get(what.code);
};
prototype.createComputePipelineAsync = function (what) {
  const name = `${what.compute.entryPoint} of ${codes.get(what.compute.module)}`;
  if (!pipelines.has(name)) pipelines.set(name, createComputePipelineAsync.call(this, what));
  return pipelines.get(name);
};
prototype.createBuffer = function (what) {
  window.onbuffer?.(what);
  return createBuffer.call(this, what);
};
let device = null;
window.share = (adapter, what) => device ??= adapter.requestDevice(what);
</script>"""
"""Its window owns the device, which the first page asks for, and hands out what is compiled already. It tells
``onbuffer`` of each new buffer."""
SHARE = """
window.owner = window.opener;
if (owner) GPUAdapter.prototype.requestDevice = async function (what) {
  return owner.share(await owner.navigator.gpu.requestAdapter(), what);
};
"""


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments: object) -> None:
        pass


class _Opening(Browser):
    """The browser of ``keeper``, with new pages as windows that ``keeper`` opens: of one process, so that
    both may hold the same objects."""

    def __init__(self, keeper: Page) -> None:
        self._keeper = keeper
        self.events = keeper.browser.events

    def send(self, method: str, session: str | None = None, timeout: float = 60, **parameters: Any) -> dict:
        send = self._keeper.browser.send
        if method != "Target.createTarget":
            return send(method, session, timeout, **parameters)
        known = self._targets()
        self._keeper.run(f"window.onbuffer = null; window.open({json.dumps(parameters['url'])}); 0")
        return {"targetId": (self._targets() - known).pop()}

    def _targets(self) -> set[str]:
        return {
            target["targetId"] for target in self._keeper.browser.send("Target.getTargets")["targetInfos"]
        }


class SharedDevice:
    """Opens pages of one folder."""

    def __init__(self, browser: Browser, address: str) -> None:
        self._address = address
        self._keeper = browser.page(f"{address}/keeper.html")
        self._opening = _Opening(self._keeper)

    def page(self, name: str, width: int, height: int, before: str = "") -> Page:
        """The page of the file ``name``; ``before`` is a script that runs first."""
        return self._opening.page(f"{self._address}/{name}", width, height, before=SHARE + before)

    def close(self) -> None:
        self._keeper.close()


@contextlib.contextmanager
def shared_device(browser: Browser, folder: Path) -> Iterator[SharedDevice]:
    """For pages in ``folder``, on a server: windows of files may not touch each other."""
    (folder / "keeper.html").write_text(KEEPER, encoding="utf-8")
    handler = functools.partial(_Quiet, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        shared = SharedDevice(browser, f"http://127.0.0.1:{server.server_port}")
        yield shared
        shared.close()
        server.shutdown()
